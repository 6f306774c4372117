//! The weights of da3-nano as data: [`WEIGHTS`] is a file `model.safetensors`, [`CONFIG`] its `config.json`.
//!
//! The crate has no code. `vidar-da3` computes the network, `vidar-nn` reads the file. The README is the model card.
//!
//! Registries refuse packages above 10 MB, so the file is stored in two halves, one of them in
//! `vidar-da3-nano-second-half`; the compiler joins them.

const FIRST_HALF: &[u8] = include_bytes!("../model.safetensors.0");
const SECOND_HALF: &[u8] = vidar_da3_nano_second_half::BYTES;
const LENGTH: usize = FIRST_HALF.len() + SECOND_HALF.len();

static JOINED: [u8; LENGTH] = {
    let mut joined = [0; LENGTH];
    let (first, second) = joined.split_at_mut(FIRST_HALF.len());
    first.copy_from_slice(FIRST_HALF);
    second.copy_from_slice(SECOND_HALF);
    joined
};

/// The weights: a file in the format safetensors, with the official key names, in f16.
pub static WEIGHTS: &[u8] = &JOINED;

/// The description of the network, in the format of the official `config.json`.
pub static CONFIG: &str = include_str!("../config.json");
