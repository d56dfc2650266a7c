//! The name that programs are linked to: before 1.0 a minor version may change the ABI.
fn main() {
    let [major, minor] =
        ["MAJOR", "MINOR"].map(|part| std::env::var(format!("CARGO_PKG_VERSION_{part}")).unwrap_or_default());
    if std::env::var("CARGO_CFG_TARGET_OS").as_deref() == Ok("linux") {
        println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libflockmap.so.{major}.{minor}");
    }
    println!("cargo::rerun-if-changed=build.rs");
}
