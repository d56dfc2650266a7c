//! A thing behind a lock that can be closed. Whoever waits for the lock does not hold the GIL, and nobody takes the
//! GIL while it holds the lock, so no two threads wait for each other.

use std::sync::Mutex;

use pyo3::prelude::*;

use crate::errors::{ClosedError, Error};

/// Something that one thread at a time works with, until it is closed.
pub(crate) struct Shared<T> {
    what: &'static str,
    inner: Mutex<Option<T>>,
}

impl<T: Send> Shared<T> {
    pub(crate) const fn new(what: &'static str, inner: T) -> Self {
        Self { what, inner: Mutex::new(Some(inner)) }
    }

    /// Works with it, without the GIL.
    pub(crate) fn with<R: Send>(&self, py: Python<'_>, work: impl FnOnce(&mut T) -> R + Send) -> PyResult<R> {
        py.detach(|| {
            let mut inner = self.inner.lock().map_err(|_| self.broken())?;
            let inner = inner.as_mut().ok_or_else(|| self.closed())?;
            Ok(work(inner))
        })
    }

    /// Takes it out: from now on it is closed. `None` if it was.
    pub(crate) fn take(&self, py: Python<'_>) -> PyResult<Option<T>> {
        py.detach(|| Ok(self.inner.lock().map_err(|_| self.broken())?.take()))
    }

    pub(crate) fn closed(&self) -> PyErr {
        ClosedError::new_err(format!("this {} was closed: make a new one", self.what))
    }

    fn broken(&self) -> PyErr {
        let what = self.what;
        Error::new_err(format!("this {what} failed inside in a former call: report it, and make a new one"))
    }
}
