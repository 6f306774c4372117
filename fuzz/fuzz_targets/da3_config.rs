//! `config.json` of a network, and the opening of a model with untrusted description and weights.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::PathBuf;
use std::sync::OnceLock;
use vidar_da3::config::json;
use vidar_da3::{Da3, Da3Options};

/// One folder a process: what is written there is overwritten by the next input.
fn folder() -> &'static PathBuf {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let folder = std::env::temp_dir().join(format!("vidar-fuzz-da3-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a scratch folder");
        folder
    })
}

fuzz_target!(|data: &[u8]| {
    // Description, a zero byte, weights; without the zero byte a description alone.
    let mut parts = data.splitn(2, |byte| *byte == 0);
    let description = parts.next().unwrap_or_default();
    if let Ok(text) = std::str::from_utf8(description)
        && let Ok(config) = json::parse(text, "fuzz")
    {
        config.validate().expect("what is parsed is valid");
        let _ = vidar_da3::memory_estimate(&config, 3, 378, 504, true);
    }
    if let Some(weights) = parts.next() {
        std::fs::write(folder().join("config.json"), description).expect("scratch");
        std::fs::write(folder().join("model.safetensors"), weights).expect("scratch");
        let _ = Da3::open(folder(), &Da3Options::default());
        let _ = std::fs::remove_file(folder().join("config.json"));
        let _ = Da3::open(folder(), &Da3Options::default());
    }
});
