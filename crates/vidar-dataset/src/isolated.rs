//! Decoders of others are kept apart from the program: one that panics costs an image, not the run.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use vidar_video::DECODER_THREAD;

/// Why an image has no pixels after its decoder's panic.
pub(crate) const BROKE_DOWN: &str =
    "the decoder broke down on it (the image is damaged, or the decoder has a fault)";

thread_local! {
    static IS_DECODING: Cell<bool> = const { Cell::new(false) };
}

/// Whether this thread is within a decoder, whose panic is an error of one image. For a program's panic hook, which has nothing to
/// report then.
pub fn is_decoding() -> bool {
    let threads = [DECODER_THREAD, vidar_bag::CHUNK_THREAD];
    IS_DECODING.get() || std::thread::current().name().is_some_and(|name| threads.contains(&name))
}

/// What a decoder gives; its panic is an error. Time is bounded by the size, which is checked beforehand.
pub(crate) fn isolated<T>(decode: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    let before = IS_DECODING.replace(true);
    // What the decoder was doing when it broke down is not used again.
    let decoded = catch_unwind(AssertUnwindSafe(decode));
    IS_DECODING.set(before);
    decoded.unwrap_or_else(|_| Err(BROKE_DOWN.into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_within_a_decoder_is_an_error_and_the_next_image_is_decoded() {
        let broken: Result<u8, String> = isolated(|| {
            assert!(is_decoding());
            panic!("as a decoder may")
        });
        assert!(broken.unwrap_err().contains("broke down"));
        assert!(!is_decoding());
        assert_eq!(isolated(|| Ok(7)), Ok(7));
    }
}
