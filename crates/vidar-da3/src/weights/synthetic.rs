//! Synthetic weights and images: deterministic, with the same bits in every language, for parity tests.
//!
//! A value is `fl(u·scale) + offset` with `u` in [−1, 1) from SplitMix64 over FNV-1a of the tensor's full key plus the
//! element's index; scale and offset follow from the key and the shape, so that activations stay of order one. Only
//! exact or correctly rounded operations are used.

use vidar_core::Image;
use vidar_core::random::splitmix64;

/// FNV-1a, 64 bits.
pub fn fnv1a64(bytes: impl IntoIterator<Item = u8>) -> u64 {
    bytes.into_iter().fold(0xCBF2_9CE4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01B3)
    })
}

/// Element `index` of the tensor whose key hashes to `seed`, before scale and offset: exact in [−1, 1).
fn unit(seed: u64, index: u64) -> f32 {
    let k = splitmix64(seed.wrapping_add(index)) >> 40;
    k as f32 * (1.0 / 8_388_608.0) - 1.0
}

/// The tensor of a key, row-major.
pub fn tensor(name: &str, shape: &[usize]) -> Vec<f32> {
    let (offset, scale) = offset_and_scale(name, shape);
    let seed = fnv1a64(name.bytes());
    let length: usize = shape.iter().product();
    let value = |i| {
        let scaled = unit(seed, i as u64) * scale;
        if offset != 0.0 { scaled + offset } else { scaled }
    };
    (0..length).map(value).collect()
}

/// Offset and scale of `u` from key and shape; the first matching rule applies.
fn offset_and_scale(name: &str, shape: &[usize]) -> (f32, f32) {
    let leaf = name.rsplit('.').next().unwrap_or(name);
    let matrix = |fan_in: usize, gain: f64| ((3.0 / fan_in as f64).sqrt() * gain) as f32;
    let fan = |axis: usize| shape.get(axis).copied().unwrap_or(1);
    match leaf {
        "gamma" => return (0.5, 0.1),
        "cls_token" | "camera_token" => return (0.0, 1.0),
        "pos_embed" => return (0.0, 0.5),
        _ => {}
    }
    if name.ends_with("cam_dec.fc_fov.0.bias") {
        return (1.0, 0.02);
    }
    let gains = [
        ("cam_dec.fc_fov.0.weight", 0.125),
        ("scratch.output_conv2.2.weight", 0.25),
        ("scratch.output_conv2_aux.3.5.weight", 0.5),
        ("scratch.sky_output_conv2.2.weight", 0.25),
    ];
    if let Some((_, gain)) = gains.iter().find(|(ending, _)| name.ends_with(ending)) {
        return (0.0, matrix(fan(1), *gain));
    }
    if shape.len() == 1 {
        return if leaf == "weight" { (1.0, 0.1) } else { (0.0, 0.02) };
    }
    if name.ends_with("resize_layers.0.weight") || name.ends_with("resize_layers.1.weight") {
        return (0.0, matrix(fan(0), 1.0));
    }
    (0.0, matrix(shape.iter().skip(1).product(), 1.0))
}

/// The test image of a seed: stripes, a checkerboard and noise, integers only.
pub fn image_u8(seed: u64, width: usize, height: usize) -> Image<[u8; 3]> {
    let noise_seed = seed.wrapping_mul(0x0100_0003).wrapping_add(0xDA3);
    Image::from_fn(width, height, |x, y| {
        let (x, y) = (x as u64, y as u64);
        [0u64, 1, 2].map(|c| {
            let base = (x * (2 + c) + y * (3 - c) + 37 * seed * (c + 1)) % 256;
            let stripes = if base < 128 { base } else { 255 - base };
            let checker = ((((x >> 4) + seed) ^ (y >> 4)) & 1) * 64;
            let index = (y * width as u64 + x) * 3 + c;
            let noise = splitmix64(index.wrapping_add(noise_seed)) >> 58;
            (stripes + checker + noise) as u8
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_generators_give_the_published_check_values() {
        assert_eq!(fnv1a64(*b"a"), 0xAF63_DC4C_8601_EC8C);
        let name = "model.backbone.pretrained.cls_token";
        assert_eq!(fnv1a64(name.bytes()), 0x2D08_46E0_A673_3FB9);
        let first = [
            0.780_043_125_152_587_9,
            0.346_286_773_681_640_6,
            -0.339_564_800_262_451_17,
            -0.860_898_256_301_879_9,
        ];
        let values = tensor(name, &[1, 1, 384]);
        assert!(first.iter().zip(&values).all(|(a, b)| *a == f64::from(*b)), "{:?}", &values[..4]);
    }

    #[test]
    fn scales_keep_the_variance_of_a_layer() {
        let weights = tensor("model.head.projects.0.weight", &[16, 300, 1, 1]);
        let mean_square = weights.iter().map(|w| f64::from(*w).powi(2)).sum::<f64>() / weights.len() as f64;
        assert!((mean_square * 300.0 - 1.0).abs() < 0.05, "{mean_square}");
        let gamma = tensor("model.backbone.pretrained.blocks.0.ls1.gamma", &[64]);
        assert!(gamma.iter().all(|g| (0.4..0.6).contains(g)));
    }
}
