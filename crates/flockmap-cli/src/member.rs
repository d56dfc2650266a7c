//! What is measured of one robot while it runs, in virtual time or in real time.

use flockmap::codec::{Codec, Encoder};
use flockmap::grid::Layer;
use flockmap::{Changes, Event, ScanReport, Stamp};

use crate::measure::{AgesByState, SentBytes, SentDatagrams};

/// RACER sends an address of 4 bytes and a state byte for each voxel …
const RACER_VOXEL_BYTES: u64 = 5;
/// … in messages of 200 voxels …
const RACER_MESSAGE_VOXELS: u64 = 200;
/// … each with 52 bytes of fields of its own. A message fits a datagram.
const RACER_MESSAGE_BYTES: u64 = 52;
/// A package of the paper may be longer than a datagram: it then takes several, as long as Ethernet and Wi-Fi
/// carry whole. Fewer headers than that cannot be.
const PAPER_DATAGRAM_BYTES: u64 = 1_472;

/// All that is measured of one robot.
#[derive(Default)]
pub struct Measures {
    /// What went out; a copy to each of several robots counts each.
    pub sent: SentDatagrams,
    /// UDP payload that came in.
    pub received: SentBytes,
    /// What RACER would have sent for the same changes, once.
    pub racer: SentDatagrams,
    /// What the paper's method would have sent for the same batches, each as one whole package, once.
    pub paper: SentDatagrams,
    paper_packages: u32,
    /// Ages of what was merged from others.
    pub ages: AgesByState,
    /// State and stamp of the scan that set it, of every voxel of the own map.
    pub onset: Layer,
    /// Where the robot was at each scan, in metres in the map's frame.
    pub path: Vec<(Stamp, [f64; 3])>,
    encoder: Encoder,
}

impl Measures {
    /// A scan was mapped.
    pub fn scan(&mut self, report: &ScanReport, stamp: Stamp) {
        self.onset.apply(&Changes::from_blocks(report.changed.clone()), stamp);
    }

    /// The robot put a datagram on the air, in so many copies.
    pub fn datagram_sent(&mut self, now: Stamp, bytes: usize, copies: u64) {
        self.sent.add(now, bytes as u64 * copies, copies);
    }

    /// Something happened; only batches that were closed count here.
    pub fn event(&mut self, now: Stamp, event: &Event) {
        let Event::BatchClosed { batch, changes, .. } = event else { return };
        let voxels = changes.len() as u64;
        let messages = voxels.div_ceil(RACER_MESSAGE_VOXELS);
        self.racer.add(now, voxels * RACER_VOXEL_BYTES + messages * RACER_MESSAGE_BYTES, messages);
        if let Ok(whole) = self.encoder.encode_whole(Codec::Paper, batch, self.paper_packages + 1, changes) {
            self.paper_packages += 1;
            let bytes = whole.bytes().len() as u64;
            self.paper.add(now, bytes, bytes.div_ceil(PAPER_DATAGRAM_BYTES));
        }
    }
}
