//! Which options stand on the command line: one that does not apply is refused, not ignored.

use anyhow::bail;
use clap::parser::ValueSource;
use clap::{ArgMatches, Args, Command, FromArgMatches};

/// The names of the options that were given, of the group of options in which this stands first. (What stands
/// before it in the command has been read already and is not seen.)
#[derive(Clone, Debug, Default)]
pub struct Given(Vec<String>);

impl Given {
    /// Refuses options that do not apply here, and says why.
    ///
    /// # Errors
    /// If one of these (by the names of their fields) was given.
    pub fn refuse(&self, names: &[&str], why: &str) -> anyhow::Result<()> {
        if let Some(name) = self.0.iter().find(|name| names.contains(&name.as_str())) {
            bail!("--{} {why}", name.replace('_', "-"));
        }
        Ok(())
    }
}

impl FromArgMatches for Given {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let ids = matches.ids().map(clap::Id::as_str);
        let given = ids.filter(|id| matches.value_source(id) == Some(ValueSource::CommandLine));
        Ok(Self(given.map(str::to_owned).collect()))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

/// It has no options of its own.
impl Args for Given {
    fn augment_args(command: Command) -> Command {
        command
    }

    fn augment_args_for_update(command: Command) -> Command {
        command
    }
}
