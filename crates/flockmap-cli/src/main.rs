//! The program `flockmap`.
fn main() {}
