//! What every function returns, and the text of the last error of a thread.

use std::any::Any;
use std::cell::RefCell;
use std::ffi::{CString, c_char};
use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// What became of a call. 0 or more is no error.
#[repr(i32)]
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Outcome {
    /// Done.
    Ok = 0,
    /// There is nothing (any more): no datagram to send, no event, no such block, an empty map. Outputs are not
    /// written.
    None = 1,
    /// A pointer is null that may not be.
    ErrorNull = -1,
    /// A length, a number, a pose or a text is none that can be.
    ErrorArgument = -2,
    /// The buffer is too small. Where a `count` is asked for, it says how much is needed.
    ErrorBuffer = -3,
    /// The options contradict each other, or one of them is out of its range.
    ErrorConfig = -4,
    /// A datagram is damaged, foreign or forged. It is counted already; go on with the next one.
    ErrorDatagram = -5,
    /// More is asked for than may be at once.
    ErrorTooLarge = -6,
    /// A file could not be read or written, or is none of its kind.
    ErrorFile = -7,
    /// An earlier call failed inside of this handle, and it is of no more use: free it.
    ErrorPoisoned = -8,
    /// A fault of the library; please report it. The handle is poisoned.
    ErrorInternal = -9,
}

/// An error on its way out.
pub(crate) struct Failure {
    outcome: Outcome,
    text: String,
}

impl Failure {
    pub(crate) fn new(outcome: Outcome, text: impl Display) -> Self {
        Self { outcome, text: text.to_string() }
    }

    pub(crate) fn argument(text: impl Display) -> Self {
        Self::new(Outcome::ErrorArgument, text)
    }

    pub(crate) fn null(what: &str) -> Self {
        Self::new(Outcome::ErrorNull, format_args!("{what} is null"))
    }

    pub(crate) fn poisoned() -> Self {
        let text = "an earlier call failed inside of this handle: free it, and make another one";
        Self::new(Outcome::ErrorPoisoned, text)
    }
}

pub(crate) type Answer = Result<Outcome, Failure>;

/// Longest text of an error that is kept, in bytes.
const TEXT_MAX: usize = 4_096;

thread_local! {
    static LAST_ERROR: RefCell<CString> = RefCell::default();
}

/// Runs the body of a function: an error is kept as text, and a panic becomes an error.
pub(crate) fn guard(function: &str, body: impl FnOnce() -> Answer) -> Outcome {
    let failure = match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(outcome)) => return outcome,
        Ok(Err(failure)) => failure,
        Err(panic) => Failure::new(Outcome::ErrorInternal, format_args!("a panic: {}", text_of(&*panic))),
    };
    keep(&format!("{function}: {}", failure.text));
    failure.outcome
}

fn text_of(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("of unknown cause")
}

fn keep(text: &str) {
    let end = (0..=TEXT_MAX.min(text.len())).rev().find(|end| text.is_char_boundary(*end)).unwrap_or(0);
    // A text of a peer or of a file may hold a 0, which would end it.
    let text = CString::new(text[..end].replace('\0', "\u{fffd}")).unwrap_or_default();
    // Not there any more while the thread ends.
    let _ = LAST_ERROR.try_with(|last| *last.borrow_mut() = text);
}

/// The text of the last error of the calling thread, in UTF-8, and "" if there was none. It says which function,
/// what was wrong, and what to do. Never null. Owned by the library; valid until the next call of this thread that
/// fails. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn flockmap_last_error() -> *const c_char {
    LAST_ERROR.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

/// The name of a result, such as "FLOCKMAP_ERROR_NULL", and "FLOCKMAP_UNKNOWN" for a number that is none. Static, never null. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn flockmap_result_name(result: i32) -> *const c_char {
    let name = match result {
        0 => c"FLOCKMAP_OK",
        1 => c"FLOCKMAP_NONE",
        -1 => c"FLOCKMAP_ERROR_NULL",
        -2 => c"FLOCKMAP_ERROR_ARGUMENT",
        -3 => c"FLOCKMAP_ERROR_BUFFER",
        -4 => c"FLOCKMAP_ERROR_CONFIG",
        -5 => c"FLOCKMAP_ERROR_DATAGRAM",
        -6 => c"FLOCKMAP_ERROR_TOO_LARGE",
        -7 => c"FLOCKMAP_ERROR_FILE",
        -8 => c"FLOCKMAP_ERROR_POISONED",
        -9 => c"FLOCKMAP_ERROR_INTERNAL",
        _ => c"FLOCKMAP_UNKNOWN",
    };
    name.as_ptr()
}

/// The version of the library, such as "0.1.0". Static, never null. Any thread. Before 1.0 a header fits the library
/// of its own minor version only: compare it with FLOCKMAP_VERSION_MAJOR and FLOCKMAP_VERSION_MINOR where the two can
/// come apart.
#[unsafe(no_mangle)]
pub extern "C" fn flockmap_version() -> *const c_char {
    const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), "\0");
    VERSION.as_ptr().cast()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::ffi::CStr;

    fn last() -> String {
        // SAFETY: ours, and read before the next call.
        unsafe { CStr::from_ptr(flockmap_last_error()) }.to_str().unwrap().to_owned()
    }

    #[test]
    fn a_panic_becomes_an_error_with_its_text() {
        assert_eq!(guard("f", || panic!("{} is wrong", 7)), Outcome::ErrorInternal);
        assert_eq!(last(), "f: a panic: 7 is wrong");
    }

    #[test]
    fn a_text_of_any_length_and_with_zeros_is_kept_as_a_c_string() {
        let text = format!("a\0{}", "ü".repeat(5_000));
        assert_eq!(guard("f", || Err(Failure::argument(&text))), Outcome::ErrorArgument);
        assert!(last().starts_with("f: a\u{fffd}ü") && last().len() < TEXT_MAX + 8);
    }

    #[test]
    fn each_thread_has_its_own_last_error() {
        guard("f", || Err(Failure::null("x")));
        std::thread::spawn(|| assert_eq!(last(), "")).join().unwrap();
        assert_eq!(last(), "f: x is null");
    }
}
