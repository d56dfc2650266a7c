//! One robot from a configuration file: `cargo run --example node -- robot.toml`. The same as `flockmap node
//! --config`.

fn main() -> anyhow::Result<()> {
    let Some(path) = std::env::args_os().nth(1) else {
        anyhow::bail!("expected the path of a configuration; see robot.example.toml");
    };
    flockmap_node::run(path.as_ref())
}
