//! Any bytes as the records of a request: what is read can be written, and is read again as it was.

use flockmap_sync::wire::{DATAGRAM_BYTES_MAX, Datagram, Request};

use super::mended;

/// A request is never made shorter than so.
const REQUEST_BYTES_MIN: usize = 265;

/// Input: how many intervals are kept; then a datagram.
pub(crate) fn run(input: &[u8]) {
    let Some((&first, rest)) = input.split_first() else { return };
    let intervals_max = 1 + usize::from(first);
    let bytes = mended(rest.to_vec(), 1);
    let Ok(datagram) = Datagram::new_checked(&bytes) else { return };
    let Ok(request) = Request::parse(&datagram, intervals_max) else { return };
    for received in &request.received {
        assert!(received.received.intervals().len() <= intervals_max);
        assert!(received.received.first().is_none_or(|first| first >= received.from));
    }
    for transfer in &request.transfers {
        assert!(transfer.accepted.intervals().len() <= intervals_max);
    }

    let header = *datagram.header();
    for bytes_max in [REQUEST_BYTES_MIN, 600, DATAGRAM_BYTES_MAX] {
        let written = request.emit(header, bytes_max);
        assert!(written.len() <= bytes_max, "{} of {bytes_max} bytes", written.len());
        let datagram = Datagram::new_checked(&written).unwrap();
        assert_eq!(*datagram.header(), header);
        let read = Request::parse(&datagram, usize::MAX >> 8).unwrap();
        // Cut it may be; more than was said it must not say.
        for received in &read.received {
            let of_stream = request.received.iter().filter(|said| said.stream == received.stream);
            let mut said =
                of_stream.filter(|said| said.received.within(received.from, u32::MAX) == received.received);
            assert!(said.next().is_some(), "{received:?} was never said");
        }
        // What is covered was covered, and named if it was said.
        if let Some(origins) = read.origins {
            assert!(request.origins.is_some());
            for received in
                request.received.iter().filter(|received| origins.contains(received.stream.origin))
            {
                assert!(
                    read.received.iter().any(|named| named.stream == received.stream),
                    "{received:?} was not named"
                );
            }
        }
        assert!(request.all_echoes || !read.all_echoes);
        // What fitted with room to spare fits again, and has one form. The writer reckons each list with five
        // bytes more than it may take, so one that was cut to the last byte may not.
        let spare = 5 * (read.received.len() + read.transfers.len());
        if written.len() + spare <= bytes_max {
            let again = read.emit(header, bytes_max);
            assert_eq!(again, written, "{request:?}\n{read:?}");
        }
    }
}
