//! Options of the shared groups that are none of a command's.

use clap::Arg;

/// Leaves these options out of a command. One that is given all the same is refused
/// ([`flockmap_cli::program::try_parse`]).
pub fn hide(names: &[&[&str]]) -> impl Fn(Arg) -> Arg {
    move |arg| {
        let is_foreign = names.iter().any(|names| names.contains(&arg.get_id().as_str()));
        if is_foreign { arg.hide(true) } else { arg }
    }
}
