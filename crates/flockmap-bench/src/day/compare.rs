//! Who holds what of whom, and whether it is the same.

use flockmap::grid::Layer;
use flockmap_cli::progress::Progress;
use flockmap_cli::stop;

use super::outcome::{MapRow, RobotRow, StreamRow};
use super::same;
use super::swarm::{Member, Swarm, whole_layer};

/// What each robot that flew holds, and whether its layers are those of their origins: by digests, since each layer is
/// compared with several.
pub fn flown(swarm: &Swarm) -> Vec<RobotRow> {
    let members = &swarm.members;
    let progress = Progress::new("layers of those that flew", (members.len() * members.len()) as u64);
    let mut rows: Vec<RobotRow> = members.iter().map(RobotRow::of).collect();
    let mut are_same = vec![true; members.len()];
    for origin in members {
        let stream = origin.robot.own_stream();
        // Each takes half a minute where there is much.
        let digest_of = |member: &Member| {
            progress.step();
            member.robot.fusion().layer(stream).filter(|_| !stop::requested()).map(Layer::digest)
        };
        let whole = members.iter().find(|member| member.whole(origin).is_some());
        let wanted = digest_of(whole.unwrap_or(origin));
        for (is_same, member) in are_same.iter_mut().zip(members).filter(|(_, one)| one.id() != origin.id()) {
            *is_same &= member.held_upto(stream) == origin.published();
            *is_same &= wanted.is_some() && digest_of(member) == wanted;
        }
    }
    if !stop::requested() {
        rows.iter_mut().zip(are_same).for_each(|(row, is_same)| row.is_same = Some(is_same));
    }
    rows
}

/// What one that joined late holds of each that flew, and how its fused map differs from that of the first of them, if
/// all layers of both are whole.
pub fn joined(joiner: &Member, flown: &[Member]) -> (Vec<StreamRow>, Option<MapRow>) {
    let streams: Vec<StreamRow> = flown.iter().map(|origin| stream(joiner, origin, flown)).collect();
    let first = flown.first().filter(|first| {
        let is_whole = |origin: &Member| !first.robot.fusion().is_in_part(origin.robot.own_stream());
        streams.iter().all(|row| row.is_same() == Some(true)) && flown.iter().all(is_whole)
    });
    let map = first.and_then(|first| {
        let held = joiner.robot.map();
        let progress = Progress::new("blocks of the fused map", held.block_count() as u64);
        let (difference, kept) = same::of_maps(held, first.robot.map(), first.own_layer(), &progress)?;
        Some(MapRow { difference, kept, blocks_forgotten: first.robot.counters().blocks_forgotten })
    });
    (streams, map)
}

fn stream(joiner: &Member, origin: &Member, flown: &[Member]) -> StreamRow {
    let stream = origin.robot.own_stream();
    let held = joiner.robot.fusion().layer(stream);
    // What of it is left, or all.
    let whole = whole_layer(flown, origin);
    let left = whole.or_else(|| origin.own_layer());
    let difference = left.and_then(|wanted| {
        let progress =
            Progress::new(&format!("blocks of robot {}", origin.id()), wanted.block_count() as u64);
        same::of_layers(held, wanted, &progress)
    });
    StreamRow {
        robot: origin.id(),
        packages: joiner.held_upto(stream),
        packages_published: origin.published(),
        voxels: held.map_or(0, Layer::len),
        voxels_left: left.map_or(0, Layer::len),
        is_dropped: whole.is_none(),
        difference,
    }
}
