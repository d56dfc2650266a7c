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
        "t_l",
        "t_l_occupied",
        "d",
    ];
    if foreign.contains(&arg.get_id().as_str()) { arg.hide(true) } else { arg }
}

/// As [`hide_foreign`]; cycles count here, the length of flights does not.
pub fn hide_foreign_to_exploration(arg: clap::Arg) -> clap::Arg {
    match arg.get_id().as_str() {
        "t_l" | "t_l_occupied" | "d" => arg,
        "seconds" | "moving_obstacles" => arg.hide(true),
        _ => hide_foreign(arg),
    }
}
