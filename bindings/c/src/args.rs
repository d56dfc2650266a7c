//! Arguments of C: pointers and lengths that may be anything short of a bad pointer.

use std::ffi::{CStr, c_char};
use std::mem::MaybeUninit;
use std::ops::Range;

use crate::result::{Failure, Outcome};

/// Most buffers of one function.
const BUFFERS_MAX: usize = 8;

/// The buffers of one call. Each is checked when it is named: null, aligned, of a length that memory can have, and
/// apart from the others if one of the two is written to.
#[derive(Default)]
pub(crate) struct Args {
    ranges: [(Range<usize>, bool); BUFFERS_MAX],
    count: usize,
}

impl Args {
    /// `count` elements to read. Null is well if there are none.
    ///
    /// # Safety
    /// If `pointer` is not null there are that many elements, and nobody writes to them during the call.
    pub(crate) unsafe fn input<'a, T>(
        &mut self,
        pointer: *const T,
        count: usize,
        what: &str,
    ) -> Result<&'a [T], Failure> {
        if count == 0 {
            return Ok(&[]);
        }
        self.check(pointer, count, what, false)?;
        // SAFETY: not null, aligned, of a possible length, apart from what is written to; the rest is the caller's word.
        Ok(unsafe { std::slice::from_raw_parts(pointer, count) })
    }

    /// Room for `count` elements. Null is well if there are none.
    ///
    /// # Safety
    /// If `pointer` is not null there is room for that many elements, which nobody else uses during the call.
    pub(crate) unsafe fn output<'a, T>(
        &mut self,
        pointer: *mut T,
        count: usize,
        what: &str,
    ) -> Result<Out<'a, T>, Failure> {
        if count == 0 {
            return Ok(Out { elements: &mut [] });
        }
        self.check(pointer, count, what, true)?;
        // SAFETY: not null, aligned, of a possible length, apart from all others; it may hold anything.
        Ok(Out { elements: unsafe { std::slice::from_raw_parts_mut(pointer.cast(), count) } })
    }

    /// The same, but null stands for "not wanted".
    ///
    /// # Safety
    /// As of [`Self::output`].
    pub(crate) unsafe fn wanted<'a, T>(
        &mut self,
        pointer: *mut T,
        count: usize,
        what: &str,
    ) -> Result<Option<Out<'a, T>>, Failure> {
        if pointer.is_null() {
            return Ok(None);
        }
        // SAFETY: as of this function.
        unsafe { self.output(pointer, count, what) }.map(Some)
    }

    /// `count` times N numbers to read.
    ///
    /// # Safety
    /// As of [`Self::input`].
    pub(crate) unsafe fn rows<'a, const N: usize, T>(
        &mut self,
        pointer: *const T,
        count: usize,
        what: &str,
    ) -> Result<&'a [[T; N]], Failure> {
        // SAFETY: as of this function; an array lies where its elements do.
        unsafe { self.input(pointer.cast(), count, what) }
    }

    /// Room for `count` times N numbers.
    ///
    /// # Safety
    /// As of [`Self::output`].
    pub(crate) unsafe fn rows_out<'a, const N: usize, T>(
        &mut self,
        pointer: *mut T,
        count: usize,
        what: &str,
    ) -> Result<Out<'a, [T; N]>, Failure> {
        // SAFETY: as of this function; an array lies where its elements do.
        unsafe { self.output(pointer.cast(), count, what) }
    }

    /// The same, but null stands for "not wanted".
    ///
    /// # Safety
    /// As of [`Self::output`].
    pub(crate) unsafe fn rows_wanted<'a, const N: usize, T>(
        &mut self,
        pointer: *mut T,
        count: usize,
        what: &str,
    ) -> Result<Option<Out<'a, [T; N]>>, Failure> {
        // SAFETY: as of this function; an array lies where its elements do.
        unsafe { self.wanted(pointer.cast(), count, what) }
    }

    fn check<T>(
        &mut self,
        pointer: *const T,
        count: usize,
        what: &str,
        is_written: bool,
    ) -> Result<(), Failure> {
        if pointer.is_null() {
            return Err(Failure::null(what));
        }
        if !pointer.is_aligned() {
            let align = align_of::<T>();
            return Err(Failure::argument(format_args!(
                "{what} does not lie on a multiple of {align} bytes"
            )));
        }
        let begin = pointer.addr();
        let bytes = count.checked_mul(size_of::<T>()).filter(|bytes| isize::try_from(*bytes).is_ok());
        let end = bytes.and_then(|bytes| begin.checked_add(bytes));
        let Some(end) = end else {
            return Err(Failure::argument(format_args!("{what}: {count} elements are more than memory has")));
        };
        let meets = |(other, written): &(Range<usize>, bool)| {
            (*written || is_written) && begin < other.end && other.start < end
        };
        if self.ranges[..self.count].iter().any(meets) {
            return Err(Failure::argument(format_args!(
                "{what} overlaps another buffer of this call: give each one its own"
            )));
        }
        let Some(free) = self.ranges.get_mut(self.count) else {
            return Err(Failure::new(Outcome::ErrorInternal, "more buffers than BUFFERS_MAX"));
        };
        (*free, self.count) = ((begin..end, is_written), self.count + 1);
        Ok(())
    }
}

/// A buffer of the caller to write to, of which nothing is read.
pub(crate) struct Out<'a, T> {
    elements: &'a mut [MaybeUninit<T>],
}

impl<T: Copy> Out<'_, T> {
    pub(crate) fn set(&mut self, at: usize, value: T) {
        self.elements[at].write(value);
    }

    /// Writes from the beginning on; as much as there is of both.
    pub(crate) fn fill(&mut self, values: impl IntoIterator<Item = T>) {
        for (element, value) in self.elements.iter_mut().zip(values) {
            element.write(value);
        }
    }

    pub(crate) const fn len(&self) -> usize {
        self.elements.len()
    }
}

/// One element to write.
///
/// # Safety
/// As of [`Args::output`].
pub(crate) unsafe fn one<'a, T: Copy>(
    args: &mut Args,
    pointer: *mut T,
    what: &str,
) -> Result<Out<'a, T>, Failure> {
    // SAFETY: as of this function.
    unsafe { args.output(pointer, 1, what) }
}

/// Writes a list of which the caller does not know the length: how long it is in any case, and the list if there is
/// room for all of it. Room for none asks for the length only.
pub(crate) fn list<T: Copy>(
    mut out: Out<'_, T>,
    mut count: Out<'_, usize>,
    values: impl ExactSizeIterator<Item = T>,
    what: &str,
) -> Result<Outcome, Failure> {
    let (needed, room) = (values.len(), out.len());
    count.set(0, needed);
    if room == 0 {
        return Ok(Outcome::Ok);
    }
    if room < needed {
        let text = format!("{needed} {what} and room for {room}: give a larger buffer");
        return Err(Failure::new(Outcome::ErrorBuffer, text));
    }
    out.fill(values);
    Ok(Outcome::Ok)
}

/// A handle, or an error that names it.
///
/// # Safety
/// If it is not null, a function of this library made it, and it is not freed yet.
pub(crate) unsafe fn handle<'a, T>(pointer: *const T, what: &str) -> Result<&'a T, Failure> {
    // SAFETY: as of this function; handles are only ever shared.
    unsafe { pointer.as_ref() }.ok_or_else(|| Failure::null(what))
}

/// A text that ends with a 0.
///
/// # Safety
/// If it is not null, it ends with a 0.
pub(crate) unsafe fn text<'a>(pointer: *const c_char, what: &str) -> Result<&'a str, Failure> {
    if pointer.is_null() {
        return Err(Failure::null(what));
    }
    // SAFETY: as of this function.
    let text = unsafe { CStr::from_ptr(pointer) };
    text.to_str().map_err(|error| Failure::argument(format_args!("{what} is no UTF-8: {error}")))
}

/// A number that stands for yes or no.
pub(crate) fn flag(value: i32, what: &str) -> Result<bool, Failure> {
    match value {
        0 => Ok(false),
        1 => Ok(true),
        _ => Err(Failure::argument(format_args!("{what} is {value}, expected 0 or 1"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_that_no_memory_has_are_refused() {
        let one = [0u64];
        for count in [usize::MAX, usize::MAX / 8, isize::MAX as usize / 8 + 1] {
            // SAFETY: refused before it is looked at.
            let found = unsafe { Args::default().input(one.as_ptr(), count, "numbers") };
            assert!(found.is_err(), "{count}");
        }
    }

    #[test]
    fn what_is_written_overlaps_nothing() {
        let mut all = [1u8; 8];
        let at = all.as_mut_ptr();
        let mut args = Args::default();
        // SAFETY: within the array, and refused where they meet.
        unsafe {
            assert!(args.input(at, 4, "a").is_ok());
            assert!(args.input(at.add(2), 4, "b").is_ok(), "two inputs may");
            assert!(args.output(at.add(5), 2, "c").is_err());
            assert!(args.output(at.add(6), 2, "d").is_ok());
            assert!(args.input(at.add(7), 1, "e").is_err());
        }
    }

    #[test]
    fn a_pointer_that_is_not_aligned_is_refused() {
        let all = [0u32; 2];
        // SAFETY: refused before it is looked at.
        let found = unsafe { Args::default().input(all.as_ptr().byte_add(1), 1, "numbers") };
        assert!(found.is_err());
    }
}
