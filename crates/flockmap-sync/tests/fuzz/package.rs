//! Any bytes as a map package: its header keeps its rules, a datagram carries it as it is, and decoding it
//! does no harm.

use flockmap_codec::{Content, ContentKind, Decoder, Package};
use flockmap_grid::{RobotId, Stamp, Stream, VoxelBox};
use flockmap_sync::wire::{
    DATAGRAM_BYTES_MAX, Datagram, DatagramHeader, Kind, PackagesWriter, parse_packages,
};

pub(crate) fn run(input: &[u8]) {
    let package = match Package::parse(input) {
        Ok(package) => package,
        Err(error) => return assert!(!error.to_string().is_empty()),
    };
    let header = package.header();
    assert!(header.index >= 1 && header.base < header.index);
    assert!(header.batch_start <= header.batch_end);
    assert!(header.is_independent || header.base > 0);
    if let ContentKind::Snapshot { since, chunk, chunks, .. } = header.content {
        assert!(since < header.index && chunk < chunks && header.base == 0);
    }
    assert_eq!(package.bytes(), input);

    let sender = Stream { origin: RobotId(7), epoch: 3 };
    let datagram = DatagramHeader { kind: Kind::Packages, swarm: 0, sender, stamp: Stamp(5) };
    let mut writer = PackagesWriter::new(datagram, DATAGRAM_BYTES_MAX);
    if writer.push(&package) {
        writer.push(&package);
        let bytes = writer.finish();
        assert!(bytes.len() <= DATAGRAM_BYTES_MAX);
        let carried = parse_packages(&Datagram::new_checked(&bytes).unwrap()).unwrap();
        assert!(!carried.is_empty() && carried.iter().all(|carried| *carried == package));
        assert_eq!(carried[0].header(), header);
    }

    match Decoder::new().decode(&package) {
        Ok(Content::Changes(changes)) => {
            assert_eq!(header.content, ContentKind::Changes);
            let is_within =
                |inner: VoxelBox| header.region.contains(inner.min()) && header.region.contains(inner.max());
            assert!(changes.bounding_box().is_none_or(is_within));
        }
        Ok(Content::Snapshot(_)) => assert_ne!(header.content, ContentKind::Changes),
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}
