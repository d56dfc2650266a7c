//! The numbers by which a session knows addresses.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use flockmap::Path;

/// Addresses kept beside those on which robots are reached; of more, those heard last. About 200 bytes each.
const ADDRESSES_MAX: usize = 1_024;

/// Which address a path stands for. Anybody can fill it, by sending from many addresses; what robots are
/// reached at stays.
#[derive(Debug, Default)]
pub(super) struct Addresses {
    paths: BTreeMap<SocketAddr, Path>,
    known: BTreeMap<Path, Known>,
    /// On these robots are reached. Sorted.
    used: Vec<Path>,
    /// Datagrams heard so far.
    heard: u64,
}

#[derive(Clone, Copy, Debug)]
struct Known {
    address: SocketAddr,
    /// How many datagrams had been heard when the last one came from here.
    heard: u64,
    /// It has sent to the group, so it listens there.
    is_in_group: bool,
}

impl Addresses {
    /// A datagram came from here, to the group or to this robot only.
    pub(super) fn note(&mut self, address: SocketAddr, by_group: bool) -> Path {
        self.heard += 1;
        let heard = self.heard;
        if let Some(path) = self.paths.get(&address)
            && let Some(known) = self.known.get_mut(path)
        {
            known.heard = heard;
            known.is_in_group |= by_group;
            return *path;
        }
        if self.known.len() >= ADDRESSES_MAX + self.used.len() {
            self.forget_oldest();
        }
        // Never used before: an address that was forgotten and comes again has to be tried again.
        let path = Path(heard);
        self.paths.insert(address, path);
        self.known.insert(path, Known { address, heard, is_in_group: by_group });
        path
    }

    /// Robots are reached on these, and on no others.
    pub(super) fn set_used(&mut self, paths: &[Path]) {
        self.used.clear();
        self.used.extend(paths);
        self.used.sort_unstable();
        self.used.dedup();
    }

    /// The address of a path, unless it was forgotten.
    pub(super) fn address(&self, path: Path) -> Option<SocketAddr> {
        self.known.get(&path).map(|known| known.address)
    }

    /// Where robots are reached, each address once; and whether they hear the group there.
    pub(super) fn used(&self) -> impl Iterator<Item = (SocketAddr, bool)> + '_ {
        self.used
            .iter()
            .filter_map(|path| self.known.get(path))
            .map(|known| (known.address, known.is_in_group))
    }

    fn forget_oldest(&mut self) {
        let unused = self.known.iter().filter(|(path, _)| self.used.binary_search(path).is_err());
        let Some((&path, &oldest)) = unused.min_by_key(|(_, known)| known.heard) else { return };
        self.known.remove(&path);
        self.paths.remove(&oldest.address);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(number: u32) -> SocketAddr {
        SocketAddr::from((std::net::Ipv4Addr::from_bits(0x0a00_0000 + number), 7_700))
    }

    #[test]
    fn an_address_keeps_its_path_and_no_path_is_given_twice() {
        let mut addresses = Addresses::default();
        let mut given = std::collections::BTreeSet::new();
        for number in 0..3_000 {
            let path = addresses.note(address(number), false);
            assert!(given.insert(path), "{path:?} again");
            assert_eq!(addresses.note(address(number), false), path);
            assert_eq!(addresses.address(path), Some(address(number)));
        }
        // The first ones were forgotten.
        assert!(given.insert(addresses.note(address(0), false)));
    }

    #[test]
    fn no_flood_of_addresses_forgets_where_robots_are_reached() {
        let mut addresses = Addresses::default();
        let used: Vec<Path> = (0..40).map(|number| addresses.note(address(number), number < 2)).collect();
        addresses.set_used(&used);
        let tried = addresses.note(address(40), false);
        for number in 100..10_000 {
            addresses.note(address(number), false);
            // It is heard again and again.
            assert_eq!(addresses.note(address(40), false), tried);
            assert!(
                addresses.known.len() <= ADDRESSES_MAX + 40 && addresses.paths.len() == addresses.known.len()
            );
        }
        for (number, path) in used.iter().enumerate() {
            assert_eq!(addresses.address(*path), Some(address(number as u32)));
        }
        let expected: Vec<_> = (0..40).map(|number| (address(number), number < 2)).collect();
        assert_eq!(addresses.used().collect::<Vec<_>>(), expected);

        addresses.set_used(&[]);
        assert_eq!(addresses.used().count(), 0);
        for number in 10_000..12_000 {
            addresses.note(address(number), false);
        }
        assert_eq!(addresses.address(used[0]), None, "nobody is there any more");
        assert!(addresses.known.len() <= ADDRESSES_MAX + 40);
    }
}
