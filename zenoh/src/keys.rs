//! The keys under which packages lie: `flockmap/SWARM/VERSION/STREAM/INDEX`, and beside them those of snapshots and of
//! whoever holds packages.
//!
//! | key | what |
//! |---|---|
//! | `flockmap/7/5/12-99/500` | package 500 of run 99 of robot 12, of swarm 7, in version 5 of the format |
//! | `flockmap/7/5/12-99/snapshot/1f3a9c00/3` | chunk 3 of a snapshot of that run |
//! | `flockmap/7/5/12-99/snapshot/1f3a9c00/contents` | the packages that it contains, if their history has gaps |
//! | `flockmap/7/5/@holder/NAME` | a liveliness token: somebody who holds packages and answers |
//! | `flockmap/7/5/@holder/NAME/held` | what he holds, as JSON |
//! | `flockmap/7/5/@holder/NAME/get/12-99` | what the sender of the query lacks of a run |
//!
//! `@holder` is not matched by `*` or `**`, so `flockmap/7/5/**` is packages and snapshots alone.

use std::str::FromStr;

use flockmap::codec::{ContentKind, FORMAT_VERSION};
use flockmap::{Package, RobotId, Stream};

/// What all keys begin with.
const ROOT: &str = "flockmap";
/// Where those are who hold packages.
const HOLDER: &str = "@holder";
/// Longest name of one.
pub(crate) const NAME_MAX: usize = 64;

/// Something that lies under a key.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub(crate) enum Item {
    /// A package.
    Package { stream: Stream, index: u32 },
    /// A chunk of a snapshot.
    Chunk { stream: Stream, snapshot_id: u32, chunk: u32 },
    /// What a snapshot of a history with gaps contains.
    Contents { stream: Stream, snapshot_id: u32 },
}

impl Item {
    /// What a package is put as.
    pub(crate) fn of(package: &Package) -> Self {
        let header = package.header();
        match header.content {
            ContentKind::Changes => Self::Package { stream: header.stream, index: header.index },
            ContentKind::Snapshot { id, chunk, .. } => {
                Self::Chunk { stream: header.stream, snapshot_id: id, chunk }
            }
        }
    }

    /// Reads a key, with its swarm. `None` if it is none of these, or not as it would be written here.
    pub(crate) fn parse(key: &str) -> Option<(u16, Self)> {
        let mut parts = key.split('/');
        let mut next = || parts.next();
        if next()? != ROOT {
            return None;
        }
        let swarm = number(next()?)?;
        if number::<u8>(next()?)? != FORMAT_VERSION {
            return None;
        }
        let stream = parse_stream(next()?)?;
        let item = match next()? {
            "snapshot" => {
                let snapshot_id = parse_id(next()?)?;
                match next()? {
                    "contents" => Self::Contents { stream, snapshot_id },
                    chunk => Self::Chunk { stream, snapshot_id, chunk: number(chunk)? },
                }
            }
            index => Self::Package { stream, index: number(index)? },
        };
        next().is_none().then_some((swarm, item))
    }
}

/// The keys of a swarm.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Keys {
    pub(crate) swarm: u16,
}

impl Keys {
    fn prefix(self) -> String {
        format!("{ROOT}/{}/{FORMAT_VERSION}", self.swarm)
    }

    /// Of an item.
    pub(crate) fn item(self, item: Item) -> String {
        match item {
            Item::Package { stream, index } => format!("{}/{index}", self.stream(stream)),
            Item::Chunk { stream, snapshot_id, chunk } => {
                format!("{}/snapshot/{snapshot_id:08x}/{chunk}", self.stream(stream))
            }
            Item::Contents { stream, snapshot_id } => {
                format!("{}/snapshot/{snapshot_id:08x}/contents", self.stream(stream))
            }
        }
    }

    /// What all keys of a stream begin with.
    pub(crate) fn stream(self, stream: Stream) -> String {
        format!("{}/{}", self.prefix(), stream_text(stream))
    }

    /// All packages and snapshots.
    pub(crate) fn all(self) -> String {
        format!("{}/**", self.prefix())
    }

    /// Of somebody who holds packages.
    pub(crate) fn holder(self, name: &str) -> String {
        format!("{}/{HOLDER}/{name}", self.prefix())
    }

    /// What all holders hold.
    pub(crate) fn held_of_all(self) -> String {
        format!("{}/held", self.holder("*"))
    }

    /// Where a holder is asked for what is lacking of a stream.
    pub(crate) fn get(self, name: &str, stream: Stream) -> String {
        format!("{}/get/{}", self.holder(name), stream_text(stream))
    }
}

/// The tokens of all holders of a swarm, or of all swarms, in all versions.
pub(crate) fn holders_of(swarm: Option<u16>) -> String {
    let swarm = swarm.map_or_else(|| "*".into(), |swarm| swarm.to_string());
    format!("{ROOT}/{swarm}/*/{HOLDER}/*")
}

/// Swarm, version and name in the key of a holder, or in a key below.
pub(crate) fn parse_holder(key: &str) -> Option<(u16, u8, &str)> {
    let mut parts = key.split('/');
    let (root, swarm, version) = (parts.next()?, parts.next()?, parts.next()?);
    let (holder, name) = (parts.next()?, parts.next()?);
    (root == ROOT && holder == HOLDER && is_name(name)).then_some(())?;
    Some((number(swarm)?, number(version)?, name))
}

/// What is asked of a holder: the part of the key behind its name.
pub(crate) fn parse_get(rest: &str) -> Option<Stream> {
    parse_stream(rest.strip_prefix("get/")?)
}

/// Whether this can be the name of a holder: 1 to 64 letters, digits, `-`, `_` and `.`.
pub(crate) fn is_name(name: &str) -> bool {
    let is_fine = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    (1..=NAME_MAX).contains(&name.len()) && name.bytes().all(is_fine)
}

fn stream_text(stream: Stream) -> String {
    format!("{}-{}", stream.origin.0, stream.epoch)
}

fn parse_stream(text: &str) -> Option<Stream> {
    let (origin, epoch) = text.split_once('-')?;
    Some(Stream { origin: RobotId(number(origin)?), epoch: number(epoch)? })
}

fn parse_id(text: &str) -> Option<u32> {
    let is_written_so = |id: &u32| format!("{id:08x}") == text;
    u32::from_str_radix(text, 16).ok().filter(is_written_so)
}

/// A number as it is written: without sign, spaces and zeros in front.
fn number<T: FromStr + ToString>(text: &str) -> Option<T> {
    text.parse().ok().filter(|number: &T| number.to_string() == text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn items() -> impl Strategy<Value = Item> {
        (any::<u16>(), any::<u64>(), any::<u32>(), any::<u32>(), 0..3).prop_map(
            |(origin, epoch, a, b, kind)| {
                let stream = Stream { origin: RobotId(origin), epoch };
                match kind {
                    0 => Item::Package { stream, index: a },
                    1 => Item::Chunk { stream, snapshot_id: a, chunk: b },
                    _ => Item::Contents { stream, snapshot_id: a },
                }
            },
        )
    }

    proptest! {
        #[test]
        fn a_key_says_what_lies_there_and_no_other_key_does(swarm: u16, item in items(), at in 0usize..60, byte: u8) {
            let key = Keys { swarm }.item(item);
            prop_assert_eq!(Item::parse(&key), Some((swarm, item)));
            // Whatever else it is, it is not the same said in another way.
            let mut bytes = key.into_bytes();
            let at = at % bytes.len();
            bytes[at] = byte;
            if let Ok(other) = String::from_utf8(bytes)
                && let Some((swarm, item)) = Item::parse(&other)
            {
                prop_assert_eq!(Keys { swarm }.item(item), other);
            }
        }

        #[test]
        fn no_text_makes_it_panic(text in "\\PC*", tail in "(flockmap|[0-9]{1,5}|4|@holder|[a-z]+|/){0,12}") {
            let _ = (Item::parse(&text), parse_holder(&text), Item::parse(&tail), parse_holder(&tail));
        }
    }

    #[test]
    fn what_is_written_otherwise_is_no_key() {
        let good = format!("flockmap/7/{FORMAT_VERSION}/12-99/500");
        assert!(Item::parse(&good).is_some());
        for bad in [
            format!("flockmap/07/{FORMAT_VERSION}/12-99/500"),
            format!("flockmap/7/{FORMAT_VERSION}/12-99/+500"),
            format!("flockmap/7/{FORMAT_VERSION}/12-99/500/"),
            format!("flockmap/7/{FORMAT_VERSION}/12/500"),
            format!("flockmap/65536/{FORMAT_VERSION}/12-99/500"),
            format!("flockmap/7/{FORMAT_VERSION}/12-99/snapshot/1F3A9C00/3"),
            format!("flockmap/7/{FORMAT_VERSION}/12-99/snapshot/1/3"),
            "flockmap/7/250/12-99/500".into(),
            "flock/7/4/12-99/500".into(),
            String::new(),
        ] {
            assert_eq!(Item::parse(&bad), None, "{bad}");
        }
    }

    #[test]
    fn a_holder_is_read_from_its_token_and_from_what_it_is_asked() {
        let keys = Keys { swarm: 7 };
        let stream = Stream { origin: RobotId(12), epoch: 99 };
        assert_eq!(parse_holder(&keys.holder("a-1")), Some((7, FORMAT_VERSION, "a-1")));
        let get = keys.get("a-1", stream);
        assert_eq!(parse_holder(&get), Some((7, FORMAT_VERSION, "a-1")));
        let rest = get.strip_prefix(&format!("{}/", keys.holder("a-1"))).unwrap();
        assert_eq!(parse_get(rest), Some(stream));
        assert_eq!(parse_holder(&keys.holder("a b")), None);
    }
}
