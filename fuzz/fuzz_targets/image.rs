//! PNG and JPEG headers and pixels, under limits small enough for a fuzzer's memory.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vidar_dataset::decode::{ImageLimits, decode_image};

fuzz_target!(|bytes: &[u8]| {
    let limits = ImageLimits { max_side_px: 4096, max_decoded_bytes: 16 << 20 };
    if let Ok(image) = decode_image(bytes, &limits) {
        assert!(image.width() > 0 && image.height() > 0);
        assert_eq!(image.to_gray8().data().len(), image.width() * image.height());
    }
});
