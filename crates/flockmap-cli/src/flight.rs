//! Robots in virtual time, each with the frames that it sees.

use flockmap::{RobotId, Stamp};
use flockmap_io::SubmapPose;
use flockmap_netsim::{Network, Node, RadioConfig, Watch};

use crate::progress::Progress;
use crate::sources::{Frame, Frames, Source};
use crate::stop;

/// Robots, of Flockmap or of a rival, that fly through what their sources hold.
pub struct Flight<N> {
    pub network: Network<N>,
    pub frames: Vec<Frames>,
    /// Time of the last scan so far, or of what was said of submaps.
    pub last_scan: Stamp,
    pub progress: Progress,
}

impl<N: Node> Flight<N> {
    /// `robot` makes the robot with an id, of 1 to the number of sources. `what` is said as progress.
    pub fn new(
        sources: Vec<Source>,
        radio: RadioConfig,
        what: &str,
        mut robot: impl FnMut(RobotId) -> anyhow::Result<N>,
    ) -> anyhow::Result<Self> {
        let progress = Progress::new(what, sources.iter().map(|source| source.frames_expected).sum());
        let robots = (1..=sources.len()).map(|number| robot(RobotId(number as u16)));
        let network = Network::new(robots.collect::<anyhow::Result<_>>()?, radio, Stamp(0));
        let frames = sources.into_iter().map(|source| source.frames).collect();
        Ok(Self { network, frames, last_scan: Stamp(0), progress })
    }

    /// Time of the next scan, or of what is said next of submaps; `None` after the last one, and after Ctrl-C.
    pub fn next_scan(&mut self) -> Option<Stamp> {
        let next = |frames: &mut Frames| [frames.next_stamp(), frames.submaps.next_stamp()];
        let next = self.frames.iter_mut().flat_map(next).flatten().min();
        next.filter(|_| !stop::requested())
    }

    /// Gives every robot the frames that are due. `scan` is called with its number, counted from 0. What is said of
    /// submaps is left out.
    pub fn scan_due(
        &mut self,
        scan: impl FnMut(&mut N, usize, Stamp, Frame) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        self.take_due(|_, _, _| Ok(()), scan)
    }

    /// The same with what is said of submaps, which comes before the scans that are due.
    pub fn take_due(
        &mut self,
        mut set_submap: impl FnMut(&mut N, Stamp, SubmapPose) -> anyhow::Result<()>,
        mut scan: impl FnMut(&mut N, usize, Stamp, Frame) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let now = self.network.now();
        for (number, (frames, robot)) in self.frames.iter_mut().zip(self.network.nodes_mut()).enumerate() {
            while let Some(pose) = frames.submaps.take_due(now) {
                set_submap(robot, now, pose)?;
                self.last_scan = now;
            }
            while frames.next_stamp().is_some_and(|at| at <= now) {
                if let Some(frame) = frames.next() {
                    scan(robot, number, now, frame)?;
                }
                self.last_scan = now;
                self.progress.step();
            }
        }
        Ok(())
    }

    /// Lets time pass until all is done, and gives the time. `None` if it is not by then, or after Ctrl-C.
    pub fn settle(
        &mut self,
        until: Stamp,
        watch: &mut impl Watch<N>,
        is_done: impl Fn(&[N]) -> bool,
    ) -> Option<Stamp> {
        while !is_done(self.network.nodes()) {
            if self.network.now() > until || stop::requested() {
                return None;
            }
            self.network.step(None, watch);
        }
        Some(self.network.now())
    }
}
