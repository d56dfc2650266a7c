//! What the words of a report mean, for who has met none of them.

use super::Settings;

/// A word and what it means.
pub(super) type Term = (&'static str, String);

fn terms<const N: usize>(terms: [(&'static str, &str); N]) -> Vec<Term> {
    terms.map(|(term, meaning)| (term, meaning.to_owned())).into()
}

/// Of the figures at the top.
pub(super) fn of_headline(settings: &Settings) -> Vec<Term> {
    let mut words = vec![(
        "voxel",
        format!("a cube of the map, {} m wide here: unknown, free or occupied", settings.resolution_m),
    )];
    words.extend(terms([
        (
            "agreement",
            "what each robot has received of each other one beside what that one published, voxel by voxel. It must be 100 %",
        ),
        ("on the wire", "all bytes of all datagrams: changes, headers, requests, repairs, and the 28 bytes of IP and UDP"),
        ("KB", "1,024 bytes"),
        (
            "age",
            "time from the scan that showed a voxel to its place in another robot's map: it waits for its batch, and for \
             repair where the radio lost it",
        ),
        ("obstacle", "an occupied voxel"),
        (
            "RACER",
            "an exploration method for swarms (Zhou et al., 2023) whose robots exchange lists of changed voxels: 5 bytes for \
             each, and 52 for each message of 200",
        ),
        (
            "the paper",
            "Shi, Yin et al. (IROS 2024), the method that Flockmap begins with: a box around what changed, two bits for each \
             voxel in it, zlib",
        ),
        (
            "how they are compared",
            "the changes that the robots sent are coded by RACER's method and the paper's too, and counted with the same \
             headers. Theirs go out once, as over a radio that loses nothing: no requests, no repairs. Flockmap's bytes \
             hold both, over the radio of this run",
        ),
    ]));
    words
}

/// Of the table of bytes.
pub(super) fn of_bytes() -> Vec<Term> {
    terms([
        ("sent", "who sent it; the rivals' rows say how many times Flockmap's bytes on the wire theirs are"),
        ("payload", "bytes in all datagrams: changes, requests, repairs, with all headers of Flockmap"),
        ("IP + UDP", "28 bytes of headers for each datagram, on top"),
        ("avg KB/s", "payload, IP and UDP, from the first to the last scan"),
        ("max KB/s", "the same in the largest window of one second"),
        ("batch", "what changed in a robot's own map in one publish period"),
        ("packages", "parts of a batch that fit a datagram, 1,150 bytes at most; how many were sent"),
        ("requests", "datagrams in which a robot says what it has received and what it lacks"),
        ("resent", "packages that were found lost and sent again"),
        ("relayed", "packages of another robot that were passed on"),
    ])
}

/// Of the table of ages.
pub(super) fn of_ages() -> Vec<Term> {
    terms([
        ("age of what arrived", "time from the scan that showed a voxel to its place in another robot's map"),
        ("voxels", "how many arrived, each time that one changed"),
        ("median s", "half of them were younger when they arrived, in seconds"),
        ("99 % s", "99 of 100 were younger"),
        ("largest s", "the oldest"),
    ])
}

/// Of the table of times.
pub(super) fn of_times() -> Vec<Term> {
    terms([
        ("time, one core", "computing time of one step on one core of this machine"),
        ("map a scan", "from a scan of the LiDAR to the robot's own map"),
        ("t_pack", "from the end of a batch to its packages, ready to be sent (the paper's name for it)"),
        ("t_recv2insert", "from a datagram to its voxels in the fused map (the paper's name for it)"),
        ("count", "how often the step was taken"),
        ("mean ms", "milliseconds on average"),
        ("99 % ms", "99 of 100 took less"),
        ("paper ms", "mean in the paper's Table IV, on its robots' computer"),
    ])
}

/// Of the tables of maps and layers.
pub(super) fn of_layers() -> Vec<Term> {
    terms([
        ("layer", "all that one robot has published so far; each robot holds a layer of each other one"),
        (
            "fused map",
            "all layers and what the robot itself saw, in one: the map that it plans on. Where several saw a voxel, the \
             newest observation counts",
        ),
        ("map", "whose fused map it is"),
        ("free", "voxels that are known to be empty"),
        ("occupied", "voxels with an obstacle"),
        ("layers held", "of which robot, and how many voxels are in it"),
        ("voxels", "how many are known in the layer here or at the robot that published it"),
        ("equal", "share of them that are the same here and there"),
        ("packages", "how many arrived, of those that were published"),
    ])
}

/// Of the table of fused maps.
pub(super) fn of_fused() -> Vec<Term> {
    terms([
        ("robots", "the two whose fused maps lie side by side"),
        ("both know", "voxels that are known in both fused maps"),
        ("equal", "share of them in the same state in both"),
        ("both saw", "voxels that both robots saw themselves"),
        ("equal of these", "share of them in the same state in both fused maps"),
        (
            "why they differ",
            "layers must be equal; fused maps need not be. Where both saw a voxel, each trusts the newest observation, and \
             its own is always newer than what has been published of it; a voxel on the edge of an obstacle looks free from \
             one side and occupied from the other; clocks that differ decide otherwise which is newer",
        ),
        (
            "frame",
            "voxels can be compared where robots share a frame: here the poses of all of them are taken as in one. Robots with \
             frames of their own have grids that do not lie on each other, and no such share",
        ),
    ])
}

/// What was set: name, value, meaning.
pub(super) fn of_settings(s: &Settings, record_s: f64) -> Vec<[String; 3]> {
    let obstacle_period =
        s.obstacle_period_s.map_or_else(|| "as free space".to_owned(), |t| format!("{t} s"));
    let rows = [
        ("voxel side", format!("{} m", s.resolution_m), "the map is made of cubes of this size"),
        ("range", format!("{} m", s.range_m), "what the LiDAR sees beyond it is not mapped"),
        (
            "publish period",
            format!("{} s", s.publish_period_s),
            "so often a robot publishes what changed: a batch",
        ),
        ("obstacle period", obstacle_period, "the same for obstacles, where they go ahead of free space"),
        (
            "batch limit",
            format!("{} voxels", crate::numbers::thousands(s.batch_limit as u64)),
            "a batch is published earlier once so many voxels have changed",
        ),
        ("mapper", s.mapper.clone(), "rules by which hits and passing rays make a voxel occupied or free"),
        ("codec", s.codec.clone(), "how changes become bytes: flock is Flockmap's, paper is the paper's"),
        (
            "sending",
            s.cast.to_owned(),
            "unicast: a copy to each robot, and each counts; broadcast: once for all",
        ),
        ("radio", s.radio.clone(), "what happens to datagrams on their way"),
        ("seed", s.seed.to_string(), "decides all that is random"),
        ("length", format!("{record_s:.1} s"), "from the first to the last scan"),
    ];
    rows.map(|(name, value, meaning)| [name.to_owned(), value, meaning.to_owned()]).into()
}
