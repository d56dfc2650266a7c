//! One reader of a map: what it is given, and how it is sent. Whoever has a map serves its readers with this: a
//! node over its sockets, a recording, and both over the WebSockets of the view.

mod given;
mod reader;
mod tally;

pub use given::{BlocksFuture, BlocksNow, Given, Giver, Identity, Numbered};
pub use reader::{Closed, Connection, Reader};
pub use tally::Tally;
