//! Work on several threads at once.

use std::sync::Mutex;

/// Does something with each of these, on so many threads; with its number, and in no particular order.
pub(crate) fn in_parallel<T: Send>(threads: usize, items: &mut [T], work: impl Fn(usize, &mut T) + Sync) {
    let threads = threads.min(items.len());
    let left = Mutex::new(items.iter_mut().enumerate());
    let next = || left.lock().ok().and_then(|mut left| left.next());
    let work_off = || {
        while let Some((number, item)) = next() {
            work(number, item);
        }
    };
    std::thread::scope(|scope| {
        for _ in 1..threads {
            scope.spawn(work_off);
        }
        work_off();
    });
}
