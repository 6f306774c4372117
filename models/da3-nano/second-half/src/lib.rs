#![doc = include_str!("../README.md")]

/// What follows the bytes of `vidar-da3-nano` in `model.safetensors`.
pub const BYTES: &[u8] = include_bytes!("../model.safetensors.1");
