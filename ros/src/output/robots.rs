//! Where the team is, as a `visualization_msgs/MarkerArray`.

use std::time::{Duration, Instant};

use flockmap::{KnownPose, RobotId, Stamp};
use flockmap_io::ros::{ColorRGBA, Marker, MarkerArray, Pose};

use super::outlet::{Outlet, Output, Shot};

/// A robot that was not heard for so long fades away.
const SHOWN: Duration = Duration::from_secs(30);

/// A sphere and a name for each robot.
pub(crate) struct Robots {
    outlet: Outlet<MarkerArray>,
    own: RobotId,
    turn: u64,
}

impl Robots {
    pub(crate) const fn new(outlet: Outlet<MarkerArray>, own: RobotId) -> Self {
        Self { outlet, own, turn: 0 }
    }

    fn markers(&self, shot: &Shot, robot: &KnownPose) -> [Marker; 2] {
        let id = robot.stream.origin;
        let colour = colour_of(id);
        let sphere = Marker {
            header: shot.header.clone(),
            ns: "robots".into(),
            id: i32::from(id.0),
            r#type: Marker::SPHERE,
            action: Marker::ADD,
            pose: Pose { position: robot.position, ..Pose::default() },
            scale: [0.4; 3],
            color: colour,
            lifetime: SHOWN.into(),
            ..Marker::default()
        };
        let [x, y, z] = robot.position;
        let name = Marker {
            ns: "names".into(),
            r#type: Marker::TEXT_VIEW_FACING,
            pose: Pose { position: [x, y, z + 0.5], ..Pose::default() },
            scale: [0.0, 0.0, 0.4],
            text: if id == self.own { format!("{} (here)", id.0) } else { id.0.to_string() },
            ..sphere.clone()
        };
        [sphere, name]
    }
}

impl Output for Robots {
    fn publish(&mut self, shot: &Shot, now: Instant) -> Result<(), String> {
        // Said again and again, also of who stands still: markers fade.
        self.turn += 1;
        if !self.outlet.wants(self.turn, None, now) {
            return Ok(());
        }
        let newest = shot.poses.iter().map(|robot| robot.seen).max().unwrap_or(Stamp(0));
        let is_shown = |robot: &&KnownPose| newest.micros_since(robot.seen) < SHOWN.as_micros() as i64;
        let markers =
            shot.poses.iter().filter(is_shown).flat_map(|robot| self.markers(shot, robot)).collect();
        self.outlet.send(MarkerArray { markers })
    }

    fn due(&self) -> Instant {
        self.outlet.due()
    }
}

/// Colours that lie far apart for robots whose numbers do not.
fn colour_of(robot: RobotId) -> ColorRGBA {
    let hue = f64::from(robot.0) * 0.618_034 % 1.0 * 6.0;
    let ramp = |shift: f64| (((hue + shift) % 6.0 - 3.0).abs() - 1.0).clamp(0.0, 1.0) as f32;
    ColorRGBA { r: ramp(0.0), g: ramp(4.0), b: ramp(2.0), a: 1.0 }
}
