//! Keys that mean nothing without another one: given alone, they are a mistake, and not ignored.

use super::convert::value;
use super::error::ConfigError;
use super::places::Places;

/// A key, and those of which one must be there for it to mean something.
const NEEDS: &[(&str, &[&str])] = &[
    ("[sensor] speed", RECORD),
    ("[sensor] start_s", RECORD),
    ("[sensor] repeat", RECORD),
    ("[sensor] points_topic", RECORD),
    ("[sensor] odometry_topic", RECORD),
    ("[sensor] map_frame", RECORD),
    ("[sensor] submaps_topic", RECORD),
    ("[sensor] poses", RECORD),
    ("[sensor] unix_mode", &["[sensor] listen_unix"]),
    ("[sensor] stamp_error_max_s", LISTEN_OR_ROS),
    ("[sensor] scan_points_max", &["[sensor] record", "[sensor] listen_tcp", "[sensor] listen_unix", ROS]),
    ("[sensor] states_max", LISTEN),
    ("[sensor] box_states_max", LISTEN),
    ("[teammates] radius_m", LISTEN_OR_ROS),
    ("[teammates] timeout_ms", LISTEN_OR_ROS),
    ("[store] bytes_max", &["[store] path"]),
    ("[store] sync_ms", &["[store] path"]),
    ("[network] multicast_interface", MULTICAST),
    ("[network] multicast_interface_index", MULTICAST),
    ("[network] multicast_ttl", MULTICAST),
    ("[map_output] unix_mode", &["[map_output] listen_unix"]),
    ("[map_output] readers_max", OUTLETS),
    ("[map_output] period_ms", OUTLETS),
    ("[record] scans", RECORDED),
    ("[record] origins", RECORDED),
    ("[record] picture_period_s", RECORDED),
    ("[record] bytes_max", RECORDED),
    ("[view] token", &["[view] listen"]),
    ("[view] token_file", &["[view] listen"]),
    ("[output] save_free", &["[output] save_map_at_end"]),
];

const RECORD: &[&str] = &["[sensor] record"];
const LISTEN: &[&str] = &["[sensor] listen_tcp", "[sensor] listen_unix"];
const LISTEN_OR_ROS: &[&str] = &["[sensor] listen_tcp", "[sensor] listen_unix", ROS];
/// Scans come from the program that has the node, whether its section is there or not.
const ROS: &str = "[ros]";
const OUTLETS: &[&str] = &["[map_output] listen_unix", "[map_output] listen_tcp", "[view] listen"];
const RECORDED: &[&str] = &["[record] path"];
const MULTICAST: &[&str] = &["[network] multicast"];

/// Keys of which at most one may be given.
const EITHER: [&[&str]; 5] = [
    &["[sensor] record", "[sensor] listen_tcp", "[sensor] listen_unix"],
    &["[network] broadcast", "[network] multicast"],
    &["[view] token", "[view] token_file"],
    &["[sensor] submaps_topic", "[submaps] length_m"],
    // A run begins with the first submap, and has it once.
    &["[sensor] submaps_topic", "[sensor] repeat"],
];

/// Whether each key of a file means something beside the others. `has_scans`: they come from elsewhere than the
/// sources of `[sensor]`.
///
/// # Errors
/// Names the key that does not, and what it is for.
pub(crate) fn check_applies(places: &Places, has_scans: bool) -> Result<(), ConfigError> {
    let is_given = |key: &str| if key == ROS { has_scans } else { places.has(key) };
    for (key, needs) in NEEDS {
        if places.has(key) && !needs.iter().any(|needed| is_given(needed)) {
            let needs: Vec<&str> = needs.iter().copied().filter(|needed| *needed != ROS).collect();
            let expected = format!("{} beside it, without which it means nothing", needs.join(" or "));
            return Err(value(key, "given", expected));
        }
    }
    for keys in EITHER {
        let given: Vec<&str> = keys.iter().copied().filter(|key| places.has(key)).collect();
        if let [first, second, ..] = given[..] {
            return Err(value(first, format!("given, and {second} too"), "one of them"));
        }
    }
    if has_scans {
        if let Some(key) = EITHER[0].iter().find(|key| places.has(key)) {
            return Err(value(key, "given", "none: scans come from ROS here"));
        }
        if places.has("[output] end_when_quiet_s") {
            let expected = "not given: from ROS scans may always come, so that it is never over";
            return Err(value("[output] end_when_quiet_s", "given", expected));
        }
    }
    if places.has("[output] end_when_quiet_s")
        && let Some(socket) = LISTEN.iter().find(|socket| places.has(socket))
    {
        let expected = format!(
            "a record or no sensor beside it: with {socket} scans may always come, so that it is never over"
        );
        return Err(value("[output] end_when_quiet_s", "given", expected));
    }
    Ok(())
}
