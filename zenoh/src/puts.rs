//! From the node to Zenoh: each package that it merged or made is put under its key.

use std::collections::{HashSet, VecDeque};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};

use flockmap::{Event, Package};
use flockmap_node::store::{Contents, contents_of, packages_of};
use flockmap_node::{Observation, Observer};
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

use crate::counters::Counters;
use crate::held::intervals_text;
use crate::keys::{Item, Keys};

/// Packages that may wait to be put: some 5 MB.
const WAITING_MAX: usize = 4_096;
/// Items noted as taken, of those that the robot did not merge: 2 MB.
const NOTED_MAX: usize = 1 << 15;

/// Something to put.
pub(crate) enum Put {
    Package(Package),
    Contents(Contents),
}

/// What came from Zenoh and is not put there again.
#[derive(Clone, Debug, Default)]
pub(crate) struct Noted(Arc<Mutex<Items>>);

#[derive(Debug, Default)]
struct Items {
    set: HashSet<Item>,
    order: VecDeque<Item>,
}

impl Noted {
    /// Notes that this came from Zenoh. Of too many that were never merged the oldest are forgotten: they would be put
    /// once more, which changes nothing.
    pub(crate) fn note(&self, item: Item) {
        let mut items = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if items.set.insert(item) {
            items.order.push_back(item);
        }
        while items.order.len() > NOTED_MAX
            && let Some(oldest) = items.order.pop_front()
        {
            items.set.remove(&oldest);
        }
    }

    /// Whether it came from Zenoh.
    fn take(&self, item: Item) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).set.remove(&item)
    }
}

/// What watches the node, and where what it saw waits to be put. The node never waits for Zenoh: what finds no place is
/// counted, and whoever lacks it asks for it.
pub(crate) fn observer(noted: Noted, counters: Counters) -> (Observer, Receiver<Put>) {
    let (puts, puts_in) = sync_channel(WAITING_MAX);
    let observe = move |_, _: &flockmap::Robot, observation: Observation<'_>| {
        let Observation::Event(event) = observation else { return };
        note_event(event, &noted, &puts, &counters);
    };
    (Box::new(observe), puts_in)
}

fn note_event(event: &Event, noted: &Noted, puts: &SyncSender<Put>, counters: &Counters) {
    let packages = packages_of(event).iter().filter(|package| !noted.take(Item::of(package)));
    let contents = contents_of(event).filter(|contents| !noted.take(item_of(contents)));
    for put in packages.cloned().map(Put::Package).chain(contents.map(Put::Contents)) {
        if puts.try_send(put).is_err() {
            counters.put_failed.add(1);
        }
    }
}

pub(crate) fn item_of(contents: &Contents) -> Item {
    Item::Contents { stream: contents.stream, snapshot_id: contents.snapshot_id }
}

/// Puts what waits, until the node has ended.
pub(crate) fn put_all(session: &Session, keys: Keys, puts: &Receiver<Put>, counters: &Counters) {
    for put in puts {
        let (item, bytes) = match put {
            Put::Package(package) => (Item::of(&package), package.bytes().to_vec()),
            Put::Contents(contents) => (item_of(&contents), intervals_text(&contents.intervals).into_bytes()),
        };
        let length = bytes.len() as u64;
        // Over a thin line what is put waits, and then what finds no place to wait is left out.
        let put = session.put(keys.item(item), bytes).congestion_control(CongestionControl::Block);
        match put.wait() {
            Ok(()) => {
                counters.put.add(1);
                counters.put_bytes.add(length);
            }
            Err(_) => counters.put_failed.add(1),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::{RobotId, Stream};

    #[test]
    fn what_came_from_zenoh_is_known_once_and_the_list_is_bounded() {
        let noted = Noted::default();
        let item = |index| Item::Package { stream: Stream { origin: RobotId(1), epoch: 1 }, index };
        for index in 0..3 * NOTED_MAX as u32 {
            noted.note(item(index));
            noted.note(item(index));
        }
        let newest = 3 * NOTED_MAX as u32 - 1;
        assert!(noted.take(item(newest)) && !noted.take(item(newest)) && !noted.take(item(0)));
        let items = noted.0.lock().unwrap();
        assert!(items.set.len() <= NOTED_MAX && items.order.len() <= NOTED_MAX);
    }
}
