//! What maps take on the heap.

/// Bytes of the table of a hash map with so many entries of this size, from which none was ever taken: it has
/// a power of two of places, an eighth of them empty at least, and a byte for each.
pub(crate) const fn table_bytes(entries: usize, entry_bytes: usize) -> usize {
    let places = match entries {
        0 => return 0,
        1..=3 => 4,
        4..=7 => 8,
        _ => (entries * 8 / 7).next_power_of_two(),
    };
    places * (entry_bytes + 1) + 16
}
