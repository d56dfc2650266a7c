//! The apps that are connected: when one wants to see something, and when there are too many.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use foxglove::websocket::{ChannelView, Client, ServerListener};

/// Messages may wait for so many apps at once: each that reads nothing holds [`WAITING_MAX`](crate::run::WAITING_MAX).
pub(crate) const APPS_MAX: usize = 4;

/// What the server says of the apps.
#[derive(Clone, Debug, Default)]
pub(crate) struct Apps(Arc<Told>);

#[derive(Debug, Default)]
struct Told {
    count: AtomicUsize,
    wants_picture: AtomicBool,
}

impl Apps {
    pub(crate) fn are_too_many(&self) -> bool {
        self.0.count.load(Ordering::Relaxed) > APPS_MAX
    }

    /// Whether an app has begun to look at something since this was asked last. It has nothing of the map then, which
    /// may not change any more.
    pub(crate) fn take_wish(&self) -> bool {
        self.0.wants_picture.swap(false, Ordering::Relaxed)
    }
}

impl ServerListener for Apps {
    fn on_client_connect(&self) {
        self.0.count.fetch_add(1, Ordering::Relaxed);
    }

    fn on_client_disconnect(&self) {
        self.0.count.fetch_sub(1, Ordering::Relaxed);
    }

    fn on_subscribe(&self, _: Client, _: ChannelView<'_>) {
        self.0.wants_picture.store(true, Ordering::Relaxed);
    }
}
