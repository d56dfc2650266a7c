//! Which radio carries how many robots of which kind: what a robot maps, what that takes on the air, and what
//! the radio carries. Plain functions of figures that were measured.

mod interpolation;
mod map_cost;
mod radio;
mod swarm_costs;

pub use map_cost::{MapCost, PERIODS_S, RANGES_M, RESOLUTIONS_M, RobotKind, Scene};
pub use radio::Radio;
pub use swarm_costs::{Ages, SwarmCost, SwarmCosts};

/// Most of a radio that a plan uses, on the mean. The rest is for the seconds in which the map grows faster: in
/// the flights that were measured the busiest ten seconds of thirty took 1.05 to 2.2 times the mean.
pub const LOAD_MAX: f64 = 0.8;
/// How much longer agreement took than the bytes left alone would, on `lora` with 7, 10 and 20 robots: 1.5 to
/// 2.0 times, since requests and repairs go on meanwhile. No bound: with 5 robots, where less is left, it took 2.4
/// times (docs/radios.md).
const AGREEMENT_FACTOR: f64 = 2.2;
/// Most robots that are tried.
pub const ROBOTS_MAX: usize = 1_000;

/// What is asked.
#[derive(Clone, Debug)]
pub struct Question {
    /// The radio.
    pub radio: Radio,
    /// How many robots, 2 or more.
    pub robots: usize,
    /// How they map.
    pub kind: RobotKind,
    /// What the map of one takes in bytes a second, if that is known better than by `kind`.
    pub map_bytes_per_s: Option<f64>,
    /// Every datagram goes to each other robot on its own.
    pub is_unicast: bool,
}

/// What a swarm takes of its radio.
#[derive(Clone, Debug)]
pub struct Plan {
    /// What the map of one robot costs.
    pub map: MapCost,
    /// What the swarm costs beside that.
    pub swarm: SwarmCost,
    /// Copies of each datagram.
    pub copies: usize,
    /// Share of the radio's time that is taken; more than 1 is more than there is.
    pub load: f64,
}

/// A change after which the radio carries the robots, alone; or the most that was measured, which is not
/// enough.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Change {
    /// What changes.
    pub what: Changed,
    /// Its new value, in metres or seconds.
    pub to: f64,
    /// Load with it.
    pub load: f64,
}

/// What of a robot can change.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Changed {
    /// The side of a voxel.
    Resolution,
    /// The range of the sensor.
    Range,
    /// The publish period.
    Period,
}

/// A map that grows faster than the radio carries it.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Lag {
    /// How far the map of others is behind after a minute of flight, in seconds.
    pub behind_s: f64,
    /// How long after a flight of a minute all agree, in seconds: by the bytes that are left alone, and as it
    /// took where a radio was full.
    pub agreement_s: [f64; 2],
}

impl Plan {
    /// Works it out.
    ///
    /// # Errors
    /// The table of swarms cannot be read.
    pub fn of(question: &Question) -> anyhow::Result<Self> {
        Ok(question.plan(&SwarmCosts::of(question.radio.preset)?))
    }

    /// Whether the radio carries it, with room for the seconds in which the map grows fastest.
    pub fn fits(&self) -> bool {
        self.load <= LOAD_MAX
    }

    /// Packages of one robot on the air, with headers and repairs, in bytes a second; each copy counts.
    pub fn packages_bytes_per_s(&self) -> f64 {
        self.map.datagrams_bytes_per_s() * self.swarm.repairs * self.copies as f64
    }

    /// Requests of one robot in bytes a second; each copy counts.
    pub fn requests_bytes_per_s(&self) -> f64 {
        self.swarm.requests_bytes_per_s * self.copies as f64
    }

    /// Of a map that grows faster than the radio carries it.
    pub fn lag(&self) -> Option<Lag> {
        let left_s = 60.0 * (self.load - 1.0);
        let lag = Lag { behind_s: left_s / self.load, agreement_s: [left_s, left_s * AGREEMENT_FACTOR] };
        (self.load > 1.0).then_some(lag)
    }
}

impl Question {
    fn plan(&self, costs: &SwarmCosts) -> Plan {
        let measured = self.kind.map_cost();
        let map = self.map_bytes_per_s.map_or(measured, |bytes| self.kind.known_cost(bytes));
        let swarm = costs.at(self.robots);
        let copies = if self.is_unicast { self.robots - 1 } else { 1 };
        let mut plan = Plan { map, swarm, copies, load: 0.0 };
        let senders = if self.radio.is_shared { self.robots as f64 } else { 1.0 };
        let packages = self.radio.airtime_s(plan.packages_bytes_per_s(), plan.map.datagram_bytes);
        let requests = self.radio.airtime_s(plan.requests_bytes_per_s(), swarm.request_bytes);
        plan.load = senders * (packages + requests);
        plan
    }

    /// Most robots of this kind that the radio carries, 0 if not even two; [`ROBOTS_MAX`] if that many.
    ///
    /// # Errors
    /// The table of swarms cannot be read.
    pub fn robots_most(&self) -> anyhow::Result<usize> {
        let costs = SwarmCosts::of(self.radio.preset)?;
        let fits = |robots: &usize| Self { robots: *robots, ..self.clone() }.plan(&costs).fits();
        Ok((2..=ROBOTS_MAX).take_while(fits).last().unwrap_or(0))
    }

    /// What would have to change so that it fits, each alone and within what was measured.
    ///
    /// # Errors
    /// The table of swarms cannot be read.
    pub fn changes(&self) -> anyhow::Result<Vec<Change>> {
        let costs = SwarmCosts::of(self.radio.preset)?;
        let kind = &self.kind;
        let ends = [
            // What changes, from where to where, and the step to which it is rounded.
            (Changed::Resolution, kind.resolution_m, RESOLUTIONS_M[2], 0.01),
            (Changed::Range, kind.range_m, RANGES_M[0], -0.5),
            (Changed::Period, kind.period_s, PERIODS_S[2], 0.1),
        ];
        let ends = ends.into_iter().filter(|(_, from, to, step)| (to - from) * step > 0.0);
        Ok(ends.map(|(what, from, end, step)| self.change(&costs, what, [from, end], step)).collect())
    }

    fn change(&self, costs: &SwarmCosts, what: Changed, [from, end]: [f64; 2], step: f64) -> Change {
        let load = |to: f64| self.with(what, to).plan(costs).load;
        // Steps towards the end until it fits.
        let first = (from / step).floor();
        let steps = (1..).map(|n| (first + f64::from(n)) * step).take_while(|to| (end - to) * step > 0.0);
        let rounded = steps.map(|to| (to * 1e6).round() / 1e6);
        let to = rounded.chain([end]).find(|to| load(*to) <= LOAD_MAX).unwrap_or(end);
        Change { what, to, load: load(to) }
    }

    /// The same of a robot with another figure. What the user knows of its map changes as the measured maps do.
    fn with(&self, what: Changed, to: f64) -> Self {
        let mut kind = self.kind;
        match what {
            Changed::Resolution => kind.resolution_m = to,
            Changed::Range => kind.range_m = to,
            Changed::Period => kind.period_s = to,
        }
        let ratio = kind.map_cost().bytes_per_s / self.kind.map_cost().bytes_per_s;
        Self { kind, map_bytes_per_s: self.map_bytes_per_s.map(|bytes| bytes * ratio), ..self.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_netsim::swarm::RadioPreset;

    fn question(preset: RadioPreset, robots: usize) -> Question {
        let kind = RobotKind {
            scene: None,
            resolution_m: 0.2,
            range_m: 7.0,
            period_s: 1.0,
            obstacle_period_s: None,
        };
        let radio = Radio::of_preset(preset);
        Question { radio, robots, kind, map_bytes_per_s: None, is_unicast: false }
    }

    fn load(question: &Question) -> f64 {
        Plan::of(question).unwrap().load
    }

    #[test]
    fn a_radio_carries_as_many_robots_as_it_says() {
        for preset in RadioPreset::ALL {
            for bytes in [50.0, 300.0, 1_000.0, 5_000.0] {
                let question = Question { map_bytes_per_s: Some(bytes), ..question(preset, 2) };
                let most = question.robots_most().unwrap();
                let fits = |robots: usize| Plan::of(&Question { robots, ..question.clone() }).unwrap().fits();
                assert!(most == 0 || fits(most), "{preset}, {bytes}: {most}");
                assert!(most == ROBOTS_MAX || !fits(most.max(1) + 1), "{preset}, {bytes}: {most}");
            }
        }
    }

    #[test]
    fn more_robots_never_load_a_shared_radio_less_and_their_own_hardly() {
        for preset in RadioPreset::ALL {
            let loads: Vec<f64> = (2..60).map(|robots| load(&question(preset, robots))).collect();
            // Of a crowd each robot asks and repairs less, and it may have no one else on its radio.
            let least = if Radio::of_preset(preset).is_shared { 0.999_999 } else { 0.9 };
            let mut most = 0.0;
            for load in &loads {
                assert!(*load >= least * most, "{preset}: {loads:?}");
                most = f64::max(most, *load);
            }
        }
    }

    #[test]
    fn a_shared_radio_is_shared_and_another_is_not() {
        let [lan, wifi] = [RadioPreset::Lan, RadioPreset::Wifi]
            .map(|radio| load(&question(radio, 20)) / load(&question(radio, 2)));
        assert!(lan < 3.0 && wifi > 10.0, "{lan} {wifi}");
    }

    #[test]
    fn by_unicast_every_copy_counts() {
        let broadcast = question(RadioPreset::Wifi, 5);
        let once = load(&broadcast);
        let unicast = Question { is_unicast: true, ..broadcast };
        assert!((load(&unicast) / once - 4.0).abs() < 1e-9);
    }

    #[test]
    fn what_each_datagram_takes_on_the_air_counts() {
        let long =
            Question { radio: Radio::of_figures(6_250.0, 0.03, 0.0), ..question(RadioPreset::Lora, 5) };
        let without = load(&long);
        let short = Question { radio: Radio::of_figures(6_250.0, 0.03, 0.01), ..long };
        assert!(load(&short) > 1.05 * without);
    }

    #[test]
    fn after_a_change_it_fits_and_just_so() {
        let question = question(RadioPreset::Lora, 6);
        let question = Question { map_bytes_per_s: Some(900.0), ..question };
        assert!(load(&question) > LOAD_MAX);
        let changes = question.changes().unwrap();
        assert_eq!(changes.len(), 2, "the range is the shortest already: {changes:?}");
        for change in changes.iter().filter(|change| change.load <= LOAD_MAX) {
            let back = match change.what {
                Changed::Resolution => change.to - 0.01,
                Changed::Range => change.to + 0.5,
                Changed::Period => change.to - 0.1,
            };
            assert!(load(&question.with(change.what, back)) > LOAD_MAX, "{change:?}");
        }
    }

    #[test]
    fn where_nothing_measured_is_enough_the_most_is_said() {
        let question = Question { map_bytes_per_s: Some(1e6), ..question(RadioPreset::Lora, 6) };
        for change in question.changes().unwrap() {
            assert!(change.load > LOAD_MAX);
            assert!([RESOLUTIONS_M[2], RANGES_M[0], PERIODS_S[2]].contains(&change.to), "{change:?}");
        }
        assert_eq!(question.robots_most().unwrap(), 0);
    }

    #[test]
    fn a_map_that_grows_twice_as_fast_as_the_radio_carries_is_half_behind() {
        let mut plan = Plan::of(&question(RadioPreset::Wifi, 2)).unwrap();
        assert_eq!(plan.lag(), None);
        plan.load = 2.0;
        assert_eq!(plan.lag(), Some(Lag { behind_s: 30.0, agreement_s: [60.0, 132.0] }));
    }
}
