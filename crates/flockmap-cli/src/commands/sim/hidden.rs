//! Options of the shared groups that say nothing here.

/// Options that the shared groups hold for other commands.
pub fn hide_foreign(arg: clap::Arg) -> clap::Arg {
    let foreign = [
        "see_team_mates",
        "poses",
        "scan_period",
        "points_topic",
        "odometry_topic",
        "map_frame",
        "publish_period",
        "obstacle_period",
        "d",
    ];
    if foreign.contains(&arg.get_id().as_str()) { arg.hide(true) } else { arg }
}

/// As [`hide_foreign`]; batches count here, the length of flights does not.
pub fn hide_foreign_to_exploration(arg: clap::Arg) -> clap::Arg {
    match arg.get_id().as_str() {
        "publish_period" | "obstacle_period" | "d" => arg,
        "seconds" | "moving_obstacles" => arg.hide(true),
        _ => hide_foreign(arg),
    }
}
