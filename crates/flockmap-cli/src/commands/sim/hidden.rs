//! Options of the shared groups that say nothing here.

use clap::Arg;

/// How to read records.
const OF_RECORDS: [&str; 6] =
    ["see_team_mates", "poses", "scan_period", "points_topic", "odometry_topic", "map_frame"];

/// Leaves the options of records, and these, out of the help.
pub fn hide(others: &[&str]) -> impl Fn(Arg) -> Arg {
    move |arg| {
        let id = arg.get_id().as_str();
        let is_foreign = OF_RECORDS.contains(&id) || others.contains(&id);
        if is_foreign { arg.hide(true) } else { arg }
    }
}
