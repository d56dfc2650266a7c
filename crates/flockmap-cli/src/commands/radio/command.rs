//! The commands of a running radio: on its standard input, or beforehand with `--at`.

use std::str::FromStr;

use clap::Args;

/// One line to the radio.
#[derive(Clone, PartialEq, Debug)]
pub enum RadioCommand {
    /// Only robots of one group hear each other; who is in none hears nobody.
    Split(Vec<Vec<usize>>),
    /// Nothing passes on these links, until `join` or `heal`.
    Cut(Links),
    /// They work again.
    Join(Links),
    /// All links work again.
    Heal,
    /// Other figures for these links.
    Link(Links, LinkChange),
    /// Prints the table.
    Status,
    /// Ends the radio.
    End,
}

/// Links between robots, numbered from 1.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Links {
    /// Every link.
    All,
    /// Those from and to one robot.
    Of(usize),
    /// Both directions between two robots.
    Between(usize, usize),
    /// One direction.
    FromTo(usize, usize),
}

/// What to change about links; what is `None` stays.
#[derive(Args, Clone, Copy, PartialEq, Debug, Default)]
pub struct LinkChange {
    /// Share of datagrams that are lost, 0 to 1
    #[arg(long, value_name = "P", default_value = "0", value_parser = |text: &str| within(text, 0.0, 1.0))]
    pub loss: Option<f64>,
    /// Time from robot to robot in milliseconds
    #[arg(long, value_name = "D", default_value = "0", value_parser = |text: &str| within(text, 0.0, 60_000.0))]
    pub delay_ms: Option<f64>,
    /// Each datagram is late by up to so many milliseconds more, so that they overtake each other
    #[arg(long, value_name = "J", default_value = "0", value_parser = |text: &str| within(text, 0.0, 60_000.0))]
    pub jitter_ms: Option<f64>,
    /// Share of datagrams that arrive twice, 0 to 1
    #[arg(long, value_name = "P", default_value = "0", value_parser = |text: &str| within(text, 0.0, 1.0))]
    pub duplication: Option<f64>,
    /// Share of datagrams that arrive with one bit turned over, 0 to 1
    #[arg(long, value_name = "P", default_value = "0", value_parser = |text: &str| within(text, 0.0, 1.0))]
    pub bit_flips: Option<f64>,
}

impl LinkChange {
    /// Whether it leaves a radio perfect that was.
    pub fn is_perfect(&self) -> bool {
        let Self { loss, delay_ms, jitter_ms, duplication, bit_flips } = self;
        [loss, delay_ms, jitter_ms, duplication, bit_flips]
            .into_iter()
            .all(|figure| figure.unwrap_or(0.0) == 0.0)
    }

    /// What it does to datagrams.
    pub fn in_words(&self) -> String {
        let share = |share: f64| (share * 1e6).round() / 1e4;
        let figures = [
            (self.loss.map(share), "% of datagrams lost"),
            (self.delay_ms, "ms delay"),
            (self.jitter_ms, "ms jitter at most"),
            (self.duplication.map(share), "% arrive twice"),
            (self.bit_flips.map(share), "% arrive with a wrong bit"),
        ];
        let words =
            figures.into_iter().filter_map(|(figure, what)| Some((figure.filter(|f| *f > 0.0)?, what)));
        words.map(|(figure, what)| format!("{figure} {what}")).collect::<Vec<_>>().join(", ")
    }
}

/// A number of the command line that lies between these.
pub fn within(text: &str, low: f64, high: f64) -> Result<f64, String> {
    let number: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if (low..=high).contains(&number) { Ok(number) } else { Err(format!("{low} to {high} expected")) }
}

/// A command and when it is carried out.
#[derive(Clone, PartialEq, Debug)]
pub struct Timed {
    /// Seconds after the start.
    pub at_s: f64,
    /// What then.
    pub command: RadioCommand,
}

impl Links {
    /// These links of so many robots, each from one robot to another.
    pub fn among(self, robots: usize) -> impl Iterator<Item = (usize, usize)> {
        let all = (1..=robots).flat_map(move |from| (1..=robots).map(move |to| (from, to)));
        all.filter(move |&(from, to)| {
            from != to
                && match self {
                    Self::All => true,
                    Self::Of(robot) => from == robot || to == robot,
                    Self::Between(a, b) => (from, to) == (a, b) || (from, to) == (b, a),
                    Self::FromTo(a, b) => (from, to) == (a, b),
                }
        })
    }

    fn robots(self) -> Vec<usize> {
        match self {
            Self::All => Vec::new(),
            Self::Of(robot) => vec![robot],
            Self::Between(a, b) | Self::FromTo(a, b) => vec![a, b],
        }
    }
}

impl RadioCommand {
    /// The same, if every robot that is named exists.
    pub fn checked(self, robots: usize) -> Result<Self, String> {
        let named = match &self {
            Self::Split(groups) => groups.concat(),
            Self::Cut(links) | Self::Join(links) | Self::Link(links, _) => links.robots(),
            Self::Heal | Self::Status | Self::End => Vec::new(),
        };
        match named.iter().find(|robot| !(1..=robots).contains(*robot)) {
            Some(robot) => Err(format!("there is no robot {robot}: they are numbered 1 to {robots}")),
            None => Ok(self),
        }
    }
}

impl FromStr for RadioCommand {
    type Err = String;

    fn from_str(line: &str) -> Result<Self, String> {
        let mut words = line.split_whitespace();
        let command = words.next().unwrap_or_default();
        let mut links = || words.next().ok_or("which links? all, 1, 1-2 or 1>2")?.parse::<Links>();
        let parsed = match command {
            "split" => Self::Split(groups(words.next().unwrap_or_default())?),
            "cut" => Self::Cut(links()?),
            "join" => Self::Join(links()?),
            "heal" => Self::Heal,
            "link" => {
                let (links, mut change) = (links()?, LinkChange::default());
                for word in words.by_ref() {
                    set(&mut change, word)?;
                }
                Self::Link(links, change)
            }
            "status" => Self::Status,
            "end" => Self::End,
            other => {
                return Err(format!(
                    "`{other}` is no command; expected split, cut, join, heal, link, status or end"
                ));
            }
        };
        match words.next() {
            Some(word) => Err(format!("`{word}` is too much after `{command}`")),
            None => Ok(parsed),
        }
    }
}

impl FromStr for Links {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        if word == "all" {
            return Ok(Self::All);
        }
        let pair = |(a, b)| Ok::<_, String>((robot(a)?, robot(b)?));
        if let Some(ends) = word.split_once('>') {
            return pair(ends).map(|(a, b)| Self::FromTo(a, b));
        }
        if let Some(ends) = word.split_once('-') {
            return pair(ends).map(|(a, b)| Self::Between(a, b));
        }
        robot(word).map(Self::Of)
    }
}

impl FromStr for Timed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (at, command) = text
            .trim()
            .split_once(char::is_whitespace)
            .ok_or("expected seconds and a command, such as \"20 split 1,2/3\"")?;
        let at_s: f64 = at.parse().map_err(|_| format!("`{at}` is no number of seconds"))?;
        if !(0.0..=1e9).contains(&at_s) {
            return Err(format!("{at_s} seconds; 0 to 1,000,000,000 expected"));
        }
        Ok(Self { at_s, command: command.parse()? })
    }
}

fn robot(word: &str) -> Result<usize, String> {
    word.parse().map_err(|_| format!("`{word}` is no robot; they are numbered from 1"))
}

fn groups(word: &str) -> Result<Vec<Vec<usize>>, String> {
    if word.is_empty() {
        return Err("which groups? for example 1,2/3,4,5".into());
    }
    word.split('/').map(|group| group.split(',').map(robot).collect()).collect()
}

fn set(change: &mut LinkChange, word: &str) -> Result<(), String> {
    let (name, value) = word.split_once('=').ok_or_else(|| format!("`{word}`: NAME=VALUE expected"))?;
    let number: f64 = value.parse().map_err(|_| format!("`{word}`: `{value}` is no number"))?;
    let (place, max) = match name {
        "loss" => (&mut change.loss, 1.0),
        "delay-ms" => (&mut change.delay_ms, 60_000.0),
        "jitter-ms" => (&mut change.jitter_ms, 60_000.0),
        "duplication" => (&mut change.duplication, 1.0),
        "bit-flips" => (&mut change.bit_flips, 1.0),
        _ => {
            return Err(format!(
                "`{name}` is no figure of a link; expected loss, delay-ms, jitter-ms, duplication or bit-flips"
            ));
        }
    };
    if !(0.0..=max).contains(&number) {
        return Err(format!("`{word}`: 0 to {max} expected"));
    }
    *place = Some(number);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_read() {
        let read = |line: &str| line.parse::<RadioCommand>();
        assert_eq!(read("split 1,2/3"), Ok(RadioCommand::Split(vec![vec![1, 2], vec![3]])));
        assert_eq!(read(" cut 1>2 "), Ok(RadioCommand::Cut(Links::FromTo(1, 2))));
        assert_eq!(read("join 3"), Ok(RadioCommand::Join(Links::Of(3))));
        let change = LinkChange { loss: Some(0.5), delay_ms: Some(100.0), ..LinkChange::default() };
        assert_eq!(
            read("link 1-2 loss=0.5 delay-ms=100"),
            Ok(RadioCommand::Link(Links::Between(1, 2), change))
        );
        let timed: Timed = "20.5 heal".parse().unwrap();
        assert_eq!(timed, Timed { at_s: 20.5, command: RadioCommand::Heal });
    }

    #[test]
    fn figures_are_said_in_words_and_only_those_that_are_bad() {
        let figures = LinkChange {
            loss: Some(0.2),
            delay_ms: Some(0.0),
            bit_flips: Some(0.015),
            ..LinkChange::default()
        };
        assert_eq!(figures.in_words(), "20 % of datagrams lost, 1.5 % arrive with a wrong bit");
        assert!(!figures.is_perfect());
        assert!(LinkChange { loss: Some(0.0), ..LinkChange::default() }.is_perfect());
    }

    #[test]
    fn wrong_words_are_named() {
        let wrong = |line: &str, expected: &str| {
            let error = line.parse::<RadioCommand>().unwrap_err();
            assert!(error.contains(expected), "{line}: {error}");
        };
        wrong("slpit 1/2", "slpit");
        wrong("", "no command");
        wrong("split", "1,2/3,4,5");
        wrong("split 1,x/2", "`x`");
        wrong("cut", "which links");
        wrong("heal 3", "`3`");
        wrong("link all loss", "NAME=VALUE");
        wrong("link all loss=1.5", "0 to 1");
        wrong("link all lost=1", "lost");
        wrong("link all loss=nan", "0 to 1");
        assert!("heal".parse::<Timed>().unwrap_err().contains("seconds"));
        assert!("-1 heal".parse::<Timed>().is_err());
        assert!("cut 4".parse::<RadioCommand>().unwrap().checked(3).unwrap_err().contains("robot 4"));
        assert!("split 1/0".parse::<RadioCommand>().unwrap().checked(3).is_err());
    }
}
