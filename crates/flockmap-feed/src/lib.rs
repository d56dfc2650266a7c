//! The map of a running robot as a stream of bytes, and the mirror that a reader keeps of it. Sans-IO.
#![forbid(unsafe_code)]
