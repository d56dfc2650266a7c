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
        match self.0.iter().find(|name| names.contains(&name.as_str())) {
            Some(name) => bail!("--{} {why}", name.replace('_', "-")),
            None => Ok(()),
        }
    }

    /// The same for all options of the group.
    ///
    /// # Errors
    /// If one was given.
    pub fn refuse_all(&self, why: &str) -> anyhow::Result<()> {
        self.refuse(&self.0.iter().map(String::as_str).collect::<Vec<_>>(), why)
    }
}

impl FromArgMatches for Given {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let ids = matches.ids().map(clap::Id::as_str);
        let given = ids.filter(|id| matches.value_source(id) == Some(ValueSource::CommandLine));
        // Groups have the names of their types.
        let options = given.filter(|id| !id.starts_with(char::is_uppercase));
        Ok(Self(options.map(str::to_owned).collect()))
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
