//! What a map states that it holds, beside what the allocator gave it.
#![allow(unsafe_code, reason = "a counting allocator cannot be had without")]

use flockmap_grid::{BlockIndex, MapView, Resolution, StateBlock, UNPACKED_BYTES_MAX, VoxelBox};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// Counts the bytes that this thread holds: the test harness allocates too, in a thread of its own.
struct Counting;

thread_local! {
    static HELD: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: hands everything to the system's allocator and only counts.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        HELD.set(HELD.get().wrapping_add(layout.size()));
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        HELD.set(HELD.get().wrapping_sub(layout.size()));
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The map itself, beside its regions; a list that a map shares with its views.
const BESIDE: usize = 512;

fn held(before: usize) -> usize {
    HELD.get().wrapping_sub(before)
}

fn indices() -> impl Iterator<Item = BlockIndex> {
    (0..40).flat_map(|x| (0..30).flat_map(move |y| (0..9).map(move |z| BlockIndex::new(x, 7 * y / 5, z))))
}

fn wall(index: BlockIndex, n: i32) -> StateBlock {
    let free = u64::MAX << ((index.x + n) & 31);
    StateBlock::new([free; 8], [!free & 0xFF00_FF01; 8])
}

#[test]
fn a_map_holds_the_bytes_that_it_states_open_and_packed() {
    let before = HELD.get();
    let mut map = MapView::new(Resolution::from_metres(0.1).unwrap());
    let check = |map: &MapView, more: usize| {
        let (held, stated) = (held(before), map.memory_bytes());
        assert!((stated..=stated + more + BESIDE).contains(&held), "{held} bytes, {stated} stated");
    };
    check(&map, 0);
    indices().for_each(|index| map.set_block(index, &wall(index, 0)));
    check(&map, 0);
    let open = map.memory_bytes();
    map.pack();
    check(&map, 0);
    assert!(map.memory_bytes() < open / 4, "{} of {open} bytes", map.memory_bytes());
    // Written to here and there, emptied, let go.
    indices().step_by(401).for_each(|index| map.set_block(index, &wall(index, 1)));
    check(&map, UNPACKED_BYTES_MAX);
    map.pack();
    check(&map, UNPACKED_BYTES_MAX);
    for emptied in [0..1_200, 1_200..1_500, 1_500..3_000] {
        let emptied = indices().skip(emptied.start).take(emptied.len());
        emptied.for_each(|index| map.set_block(index, &StateBlock::default()));
        check(&map, UNPACKED_BYTES_MAX);
        map.pack();
        check(&map, UNPACKED_BYTES_MAX);
    }
    check(&map, UNPACKED_BYTES_MAX);
    // What is read is kept for who reads it again, up to a limit.
    let all = map.bounding_box().unwrap();
    for x in (all.min().x..all.max().x).step_by(64) {
        let part =
            VoxelBox::new(flockmap_grid::Voxel::new(x, all.min().y, all.min().z), [64, 999, 99]).unwrap();
        assert!(map.blocks_in(&part).count() > 0);
    }
    check(&map, UNPACKED_BYTES_MAX);
    let blocks = map.block_count();
    assert_eq!(map.blocks().count(), blocks);
    check(&map, UNPACKED_BYTES_MAX);
    drop(map);
    assert!(held(before) < BESIDE);
}
