//! What is lacking of streams whose packages are held: it was dropped for want of room.

use flockmap_grid::{RobotId, Stamp, Stream};
use std::collections::{BTreeMap, VecDeque};

/// Robots remembered that gave what they have of a stream, or did not; of more, the first is asked again.
const NOTED_MAX: usize = 128;

/// The streams of which something is lacking. At most as many as there are streams.
#[derive(Debug)]
pub(crate) struct Lacks {
    pub(crate) streams: BTreeMap<Stream, Lack>,
    /// There is room for what is lacking.
    pub(crate) has_room: bool,
    /// Nothing is lacking of these any more, and the driver does not know yet.
    pub(crate) ended: Vec<Stream>,
}

/// What is lacking of a stream.
#[derive(Debug)]
pub(crate) struct Lack {
    /// Nothing that is newer.
    pub(crate) upto: Stamp,
    /// It may be anywhere, so that packages are decoded only if they are independent.
    pub(crate) is_anywhere: bool,
    /// A snapshot has begun to come that lacks something itself, of packages up to this one and up to this stamp: what
    /// was known before as new as that was let go of.
    pub(crate) begun: Option<(u32, Stamp)>,
    /// Who is asked for the rest, and since when.
    pub(crate) asked: Option<(RobotId, Stamp)>,
    /// What has come of the rest, since something was dropped last.
    pub(crate) rest: Rest,
    /// Who has given what it has, and lacks something itself: the last ones.
    pub(crate) done: VecDeque<RobotId>,
    /// Who gave nothing in time, since all were asked last.
    pub(crate) late: VecDeque<RobotId>,
}

/// What has come again of a stream of which something was lacking, by a snapshot or by pieces of a state.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Rest {
    /// All that packages 1 to this one say, as far as who gave it had it.
    pub(crate) upto: u32,
    /// And some of that it lacked.
    pub(crate) lacks_too: bool,
}

/// Notes a robot among the last ones.
pub(crate) fn note(robots: &mut VecDeque<RobotId>, robot: RobotId) {
    if !robots.contains(&robot) {
        robots.push_back(robot);
    }
    robots.drain(..robots.len().saturating_sub(NOTED_MAX));
}

impl Lacks {
    pub(crate) const fn new() -> Self {
        Self { streams: BTreeMap::new(), has_room: true, ended: Vec::new() }
    }

    /// What is lacking of a stream, from now on up to this stamp at least.
    pub(crate) fn lack(&mut self, stream: Stream, upto: Stamp) -> &mut Lack {
        let nothing = || Lack {
            upto,
            is_anywhere: false,
            begun: None,
            asked: None,
            rest: Rest::default(),
            done: VecDeque::new(),
            late: VecDeque::new(),
        };
        let lack = self.streams.entry(stream).or_insert_with(nothing);
        lack.upto = lack.upto.max(upto);
        lack
    }

    pub(crate) fn forget(&mut self, stream: Stream) {
        self.streams.remove(&stream);
        self.ended.retain(|ended| *ended != stream);
    }
}
