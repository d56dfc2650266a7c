//! The view of a command: a page in a browser while it works, and for as long after as somebody looks.

mod flight;
mod forward;
mod recorder;

use std::net::SocketAddr;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use flockmap_view::{Access, Content, StartError, Token, ViewServer};

pub use flight::Flight;
pub use forward::Forwarded;
pub use recorder::Recorder;

use crate::stop;

/// Where the page is, if nothing else is said.
pub const ADDRESS: &str = "127.0.0.1:7781";

/// Ctrl-C is looked for this often.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Whether it is seen in a browser.
#[derive(Args, Debug, Clone, Copy)]
#[command(next_help_heading = "View")]
pub struct ViewArgs {
    /// Show it in a browser, at 127.0.0.1:7781 or another ADDRESS. Beyond the loopback only with the token that is
    /// printed. It ends with Ctrl-C
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, require_equals = true, default_missing_value = ADDRESS)]
    pub view: Option<SocketAddr>,
}

/// Starts the server of a view and says what to open.
pub fn start(address: SocketAddr, content: Content) -> anyhow::Result<ViewServer> {
    let access = if address.ip().is_loopback() {
        Access::Loopback
    } else {
        Access::Token(Token::draw().context("the system gives no random bytes")?)
    };
    let server = ViewServer::start(address, access, content).map_err(|error| match &error {
        StartError::System { error: system, .. } if system.kind() == std::io::ErrorKind::AddrInUse => {
            anyhow::anyhow!(
                "{error}: another program listens there; give another address, such as 127.0.0.1:0"
            )
        }
        _ => anyhow::Error::new(error),
    })?;
    eprintln!("open {} in a browser", server.url());
    Ok(server)
}

/// Waits until nobody wants to look any more, which Ctrl-C says: that is no early end then. Not at all where it was said
/// before.
pub fn wait(what: &str, server: &ViewServer) {
    if stop::requested() {
        return;
    }
    eprintln!("{what} stays at {} until Ctrl-C", server.url());
    while !stop::requested() {
        std::thread::sleep(LOOK_EVERY);
    }
    stop::forget();
}
