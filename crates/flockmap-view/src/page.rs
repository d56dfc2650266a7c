//! The page, as `page/build.sh` made it.

use std::io::Write;
use std::sync::OnceLock;

use axum::body::Bytes;
use flate2::Compression;
use flate2::write::GzEncoder;

/// A file of the page.
pub(crate) struct File {
    pub(crate) path: &'static str,
    pub(crate) mime: &'static str,
    pub(crate) bytes: &'static [u8],
    packed: OnceLock<Bytes>,
}

impl File {
    const fn new(path: &'static str, mime: &'static str, bytes: &'static [u8]) -> Self {
        Self { path, mime, bytes, packed: OnceLock::new() }
    }

    /// As gzip, made when it is asked for first.
    pub(crate) fn packed(&self) -> Bytes {
        let pack = || {
            let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
            // Into memory nothing fails.
            let packed = encoder.write_all(self.bytes).and_then(|()| encoder.finish());
            Bytes::from(packed.unwrap_or_default())
        };
        self.packed.get_or_init(pack).clone()
    }
}

pub(crate) static FILES: [File; 4] = [
    File::new("/", "text/html; charset=utf-8", include_bytes!("../assets/index.html")),
    File::new("/view.css", "text/css; charset=utf-8", include_bytes!("../assets/view.css")),
    File::new("/view.js", "text/javascript; charset=utf-8", include_bytes!("../assets/view.js")),
    File::new("/worker.js", "text/javascript; charset=utf-8", include_bytes!("../assets/worker.js")),
];
