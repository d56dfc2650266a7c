//! Options of the shared groups that are none of a command's.

use clap::Arg;
use flockmap_cli::options::OF_RECORDS;

/// Leaves the options of records, and these, out of a command. One that is given all the same is refused
/// ([`flockmap_cli::program::try_parse`]).
pub fn hide(others: &[&str]) -> impl Fn(Arg) -> Arg {
    move |arg| {
        let id = arg.get_id().as_str();
        let is_foreign = OF_RECORDS.contains(&id) || others.contains(&id);
        if is_foreign { arg.hide(true) } else { arg }
    }
}
