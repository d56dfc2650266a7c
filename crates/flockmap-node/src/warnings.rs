//! Warnings that come again and again are said once, with a count.

use std::time::{Duration, Instant};

/// Warnings of one period of this length are said once.
const ANY_PERIOD: Duration = Duration::from_secs(1);

/// The same warning is said again after so long at the earliest.
const SAME_PERIOD: Duration = Duration::from_secs(60);

/// Warnings that are known to be the same; of more, the one said first is forgotten.
const KINDS_MAX: usize = 32;

/// Decides which warnings are said.
#[derive(Debug, Default)]
pub(crate) struct Warnings {
    kinds: Vec<Kind>,
    said: Option<Instant>,
    left_out: u64,
}

/// Warnings that differ in their numbers only.
#[derive(Debug)]
struct Kind {
    text: String,
    said: Instant,
    /// How often it came since it was said.
    again: u64,
}

impl Warnings {
    /// What is to be said of a warning now, if anything.
    pub(crate) fn take(&mut self, now: Instant, text: &str) -> Option<String> {
        let kind: String = text.chars().filter(|c| !c.is_ascii_digit()).collect();
        if let Some(known) = self.kinds.iter_mut().find(|known| known.text == kind) {
            known.again += 1;
            if now.duration_since(known.said) < SAME_PERIOD {
                return None;
            }
            known.said = now;
            let again = std::mem::take(&mut known.again);
            return Some(format!("{text} ({again} times since this was said last)"));
        }
        if self.said.is_some_and(|said| now.duration_since(said) < ANY_PERIOD) {
            self.left_out += 1;
            return None;
        }
        self.said = Some(now);
        if self.kinds.len() >= KINDS_MAX {
            self.left_out += self.kinds.remove(0).again;
        }
        self.kinds.push(Kind { text: kind, said: now, again: 0 });
        Some(match std::mem::take(&mut self.left_out) {
            0 => text.to_owned(),
            count => format!("{text} ({count} other warnings left out before)"),
        })
    }

    /// How many were left out and are not counted in what was said; nothing is left then.
    pub(crate) fn take_left_out(&mut self) -> u64 {
        let again = self.kinds.iter_mut().map(|kind| std::mem::take(&mut kind.again));
        again.sum::<u64>() + std::mem::take(&mut self.left_out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_warning_is_said_once_a_minute_with_a_count() {
        let mut warnings = Warnings::default();
        let began = Instant::now();
        let mut said = Vec::new();
        for second in 0..150 {
            let now = began + Duration::from_secs(second);
            said.extend(warnings.take(now, &format!("message {second} is bad")).map(|text| (second, text)));
        }
        let expected = [
            (0, "message 0 is bad"),
            (60, "message 60 is bad (60 times since this was said last)"),
            (120, "message 120 is bad (60 times since this was said last)"),
        ];
        assert_eq!(said, expected.map(|(second, text)| (second, text.to_owned())));
        assert_eq!(warnings.take_left_out(), 29);
        assert_eq!(warnings.take_left_out(), 0);
    }

    #[test]
    fn of_many_different_warnings_one_a_second_is_said_and_none_is_lost_from_the_count() {
        let mut warnings = Warnings::default();
        let began = Instant::now();
        let (mut said, mut counted) = (0, 0);
        for tenth in 0..1_000 {
            let text: String = (0..=tenth % 100).map(|_| 'x').collect();
            let now = began + Duration::from_millis(100 * tenth);
            if let Some(text) = warnings.take(now, &text) {
                said += 1;
                let number = text.split(['(', ' ']).find_map(|word| word.parse::<u64>().ok());
                counted += number.unwrap_or(0) + u64::from(!text.contains("times"));
            }
            assert!(warnings.kinds.len() <= KINDS_MAX);
        }
        assert!((50..=200).contains(&said), "{said}");
        assert_eq!(counted + warnings.take_left_out(), 1_000);
    }
}
