//! The session with Zenoh: where it connects, by its own configuration.

use std::path::Path;

use anyhow::{Result, anyhow, bail};
use zenoh::{Config, Session, Wait};

/// Longest message that is taken in, in bytes. What is held by ten thousand robots is shorter.
const MESSAGE_BYTES_MAX: usize = 16 << 20;

/// Opens a session. What neither the file nor the command line says is as in Zenoh, except: a client rather than a peer
/// if there is somewhere to connect, no multicast scouting, and no shared memory.
///
/// # Errors
/// Names the file or the endpoint, and what is wrong with it.
pub(crate) fn open(file: Option<&Path>, connect: &[String], listen: &[String]) -> Result<Session> {
    let mut config = match file {
        Some(path) => {
            Config::from_file(path).map_err(|error| anyhow!("--zenoh {}: {error}", path.display()))?
        }
        None => Config::default(),
    };
    let mut set = |key: &str, value: &str| {
        config.insert_json5(key, value).map_err(|error| anyhow!("Zenoh's {key} = {value}: {error}"))
    };
    if file.is_none() {
        set("scouting/multicast/enabled", "false")?;
        set("mode", if listen.is_empty() { "\"client\"" } else { "\"peer\"" })?;
        // A router that is away comes again.
        set("connect/timeout_ms", "{ router: -1, peer: -1, client: -1 }")?;
        set("connect/exit_on_failure", "{ router: false, peer: false, client: false }")?;
        set("transport/link/rx/max_message_size", &MESSAGE_BYTES_MAX.to_string())?;
    }
    for (key, endpoints) in [("connect/endpoints", connect), ("listen/endpoints", listen)] {
        if !endpoints.is_empty() {
            set(key, &serde_json::to_string(endpoints)?)?;
        }
    }
    if file.is_none() && connect.is_empty() && listen.is_empty() {
        bail!(
            "there is nobody to talk to: --connect tcp/ROUTER:7447, --listen tcp/[::]:7447, or --zenoh FILE"
        );
    }
    zenoh::open(config).wait().map_err(|error| anyhow!("cannot open Zenoh: {error}"))
}
