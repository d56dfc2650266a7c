//! When the observations of a layer came: a bound on when they were made, whatever their stamps say.

use crate::Stamp;

/// What came of a stream until when, on this robot's clock.
///
/// Nothing was made after it came, and within a stream stamps increase. So an observation was made before
/// anything of its stream with its stamp or a newer one had come. A clock that is wrong, or an offset to it,
/// can make observations count as older than they are, but never as newer than their arrival: so they hide
/// nothing that this robot sees later.
///
/// Times of arrival are a quarter of a second apart. At most 64 kB: when it is full, pairs of the older half
/// become one.
#[derive(Debug, Default)]
pub(super) struct Received {
    /// Both numbers ascend.
    arrivals: Vec<Arrival>,
    /// The least time from a stamp to the arrival, in microseconds: with a clock offset below this, no
    /// observation comes before it was made.
    delay_min: Option<i64>,
}

#[derive(Clone, Copy, Debug)]
struct Arrival {
    /// The newest stamp that had come.
    newest: Stamp,
    /// It had come before this time.
    by: Stamp,
}

/// Times of arrival are rounded up to a multiple of this.
const TICK_MICROS: i64 = 250_000;
/// Most of them.
const ARRIVALS_MAX: usize = 4_096;

impl Received {
    /// Notes that something with this stamp has come. With how far the clock is off now, whether something
    /// that came earlier counts as made at another time than before, which can be once in a thousand
    /// arrivals.
    pub(super) fn note(&mut self, stamp: Stamp, now: Stamp, clock_offset_micros: i64) -> bool {
        let by = Stamp(now.0.saturating_sub(now.0.rem_euclid(TICK_MICROS)).saturating_add(TICK_MICROS));
        let mut is_changed = false;
        match self.arrivals.last_mut() {
            Some(last) if stamp <= last.newest => return false,
            Some(last) if by <= last.by => last.newest = stamp,
            _ => {
                if self.arrivals.len() >= ARRIVALS_MAX {
                    is_changed = self.thin(clock_offset_micros);
                }
                self.arrivals.push(Arrival { newest: stamp, by });
            }
        }
        self.note_delay();
        is_changed
    }

    /// When, on this robot's clock, an observation of the stream was made.
    pub(super) fn made(&self, stamp: Stamp, clock_offset_micros: i64) -> Stamp {
        let stated = stamp.plus_micros(clock_offset_micros);
        if self.delay_min.is_none_or(|delay| clock_offset_micros < delay) {
            return stated;
        }
        let at = self.arrivals.partition_point(|arrival| arrival.newest < stamp);
        self.arrivals.get(at).map_or(stated, |arrival| stated.min(arrival.by))
    }

    /// Bytes on the heap.
    pub(super) const fn memory_bytes(&self) -> usize {
        self.arrivals.capacity() * size_of::<Arrival>()
    }

    /// The most bytes that one more arrival can add. While the list grows, the old one is there too.
    pub(super) fn growth_max(&self) -> usize {
        let is_full = self.arrivals.len() == self.arrivals.capacity() && self.arrivals.len() < ARRIVALS_MAX;
        if is_full { (2 * self.arrivals.capacity()).max(4) * size_of::<Arrival>() } else { 0 }
    }

    /// Makes one of each pair of the older half. Where it makes a difference the earlier time holds for both,
    /// so that nothing counts as newer than it came; where the clock leaves room, the later one, so that
    /// nothing counts as older than it is.
    fn thin(&mut self, clock_offset_micros: i64) -> bool {
        let mut is_changed = false;
        let one_of = |pair: &[Arrival; 2]| {
            let [earlier, later] = *pair;
            let is_ahead = earlier.newest.plus_micros(clock_offset_micros) > earlier.by;
            is_changed |= is_ahead;
            Arrival { newest: later.newest, by: if is_ahead { earlier.by } else { later.by } }
        };
        let (pairs, _) = self.arrivals[..ARRIVALS_MAX / 2].as_chunks::<2>();
        let older: Vec<Arrival> = pairs.iter().map(one_of).collect();
        self.arrivals.splice(..ARRIVALS_MAX / 2, older);
        self.delay_min = None;
        (0..self.arrivals.len()).for_each(|at| self.note_delay_of(at));
        is_changed
    }

    fn note_delay(&mut self) {
        self.note_delay_of(self.arrivals.len().saturating_sub(1));
    }

    fn note_delay_of(&mut self, at: usize) {
        if let Some(arrival) = self.arrivals.get(at) {
            let delay = arrival.by.micros_since(arrival.newest);
            self.delay_min = Some(self.delay_min.map_or(delay, |least| least.min(delay)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The rule in plain words: not before anything of the stream with that stamp or a newer one had come, to
    /// a tick.
    fn naive(arrivals: &[(Stamp, Stamp)], stamp: Stamp, offset: i64) -> Stamp {
        let came = arrivals.iter().filter(|(other, _)| *other >= stamp).map(|(_, at)| i128::from(at.0)).min();
        let tick = i128::from(TICK_MICROS);
        let by = came.map(|at| (at.div_euclid(tick) + 1) * tick);
        let stated = (i128::from(stamp.0) + i128::from(offset)).clamp(i64::MIN.into(), i64::MAX.into());
        let made = by.map_or(stated, |by| by.min(stated));
        Stamp(made.clamp(i64::MIN.into(), i64::MAX.into()) as i64)
    }

    fn stamp() -> impl Strategy<Value = i64> {
        prop_oneof![4 => -3_000_000..3_000_000i64, 1 => any::<i64>(), 1 => prop::sample::select(vec![i64::MIN, i64::MAX])]
    }

    proptest! {
        #[test]
        fn an_observation_counts_as_made_not_later_than_when_it_came(
            arrivals in prop::collection::vec((stamp(), 0..200_000i64), 1..60), asked in prop::collection::vec((stamp(), stamp()), 1..20),
        ) {
            let (mut received, mut model, mut now) = (Received::default(), Vec::new(), Stamp(-1_000_000));
            for (stamp, pause) in arrivals {
                now = now.plus_micros(pause);
                let before: Vec<Stamp> =
                    model.iter().map(|(stamp, _): &(Stamp, Stamp)| received.made(*stamp, 0)).collect();
                prop_assert!(!received.note(Stamp(stamp), now, 0));
                let after: Vec<Stamp> = model.iter().map(|(stamp, _)| received.made(*stamp, 0)).collect();
                prop_assert_eq!(before, after, "what came before stays as it was");
                model.push((Stamp(stamp), now));
                for (offset, _) in &asked {
                    let made = received.made(Stamp(stamp), *offset);
                    prop_assert_eq!(made, naive(&model, Stamp(stamp), *offset));
                    prop_assert!(made <= now.plus_micros(TICK_MICROS));
                }
            }
            // Of what stands in a layer, every stamp has come.
            let newest = model.iter().map(|(stamp, _)| *stamp).max().unwrap();
            for (offset, stamp) in asked {
                let stamp = Stamp(stamp).min(newest);
                prop_assert_eq!(received.made(stamp, offset), naive(&model, stamp, offset));
            }
        }
    }

    #[test]
    fn what_came_in_hours_takes_64_kilobytes_and_a_sound_clock_never_makes_a_difference() {
        let (offset, second) = (-77_000_000, 1_000_000);
        let mut received = Received::default();
        for arrival in 0..50_000 {
            // Made 40 ms before it came.
            let now = arrival * second;
            assert!(!received.note(Stamp(now - 40_000 - offset), Stamp(now), offset));
            assert!(received.memory_bytes() <= 65_536);
        }
        for arrival in 0..50_000 {
            let made = arrival * second - 40_000;
            assert_eq!(received.made(Stamp(made - offset), offset), Stamp(made));
        }
    }

    #[test]
    fn of_a_clock_that_is_ahead_nothing_ever_counts_as_made_after_it_came() {
        let (day, second) = (86_400_000_000, 1_000_000);
        let (mut received, mut changed) = (Received::default(), 0);
        for arrival in 0..20_000 {
            changed += i32::from(received.note(Stamp(day + arrival), Stamp(arrival * second), 0));
        }
        assert!((1..20).contains(&changed), "{changed} times something that came earlier counts otherwise");
        let made: Vec<i64> = (0..20_000).map(|arrival| received.made(Stamp(day + arrival), 0).0).collect();
        assert!(made.iter().zip(0..).all(|(made, arrival)| *made <= arrival * second + TICK_MICROS));
        assert!(made.is_sorted());
        // And what came lately is kept exactly.
        assert!(
            made.iter().zip(0..).skip(18_500).all(|(made, arrival)| *made == arrival * second + TICK_MICROS)
        );
    }
}
