//! What the fuzzer of the store found worth keeping, and what it does, for a second: see `fuzz/README.md`.

#[path = "fuzz/store.rs"]
mod store;

use std::path::Path;

use proptest::prelude::*;

#[test]
fn the_corpus_of_the_store_does_no_harm() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus/store");
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(!files.is_empty());
    for file in files {
        println!("{}", file.display());
        let input = std::fs::read(file).unwrap();
        store::run(&input);
        store::inspect_one(&input);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 100, ..ProptestConfig::default() })]
    #[test]
    fn any_pieces_in_any_order_do_no_harm(
        pieces in prop::collection::vec(
            prop_oneof![
                6 => (192..=255u8).prop_map(|package| vec![package]),
                1 => prop::collection::vec(any::<u8>(), 0..127).prop_map(|raw| [&[raw.len() as u8][..], &raw].concat()),
                1 => (128..192u8, prop::collection::vec(any::<u8>(), 0..300)).prop_map(|(kind, content)| {
                    [&[kind][..], &(content.len() as u16).to_le_bytes(), &content].concat()
                }),
            ],
            0..40,
        ),
    ) {
        store::run(&pieces.concat());
    }
}
