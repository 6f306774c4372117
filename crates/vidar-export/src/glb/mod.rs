//! GLB (binary glTF 2.0): coloured meshes and point clouds for any 3-D viewer.
//!
//! - glTF is y-up; VIDAR's world is z-up, unless poses with another up were given. The vertices are not changed; the root node `world` has the
//!   rotation (x, y, z) ↦ (x, z, −y) as its matrix.
//! - `POSITION` (metres) and `NORMAL` are `float`; `COLOR_0` is RGBA of normalised 16 bits. glTF requires linear light,
//!   VIDAR's colours are sRGB: they are converted, and 16 bits restore every sRGB byte.
//! - Confidence is the application's own attribute `_CONFIDENCE`.
//! - Indices are `unsigned int`; a mesh without triangles, and a cloud, is drawn as points.
//! - Coloured surfaces are unlit (`KHR_materials_unlit`), because their colours include the lighting of the images.
//! - A textured mesh has two primitives: one with `TEXCOORD_0` and the texture as a JPEG inside the file, and one with `COLOR_0` of what no
//!   image shows. Textures are sRGB, as the images are, and nothing is converted. [`read_glb`] reads its triangles, not its texture.
//! - `asset.extras` has the turn of the root node and the caller's comments, frame and unit among them. An empty cloud has a node and no mesh.
//!
//! Read: the default scene of a GLB with one binary chunk; node trees with matrices or TRS; primitives of triangles or
//! points, indexed or not; colours of 8, 16 bits or float; strides. Sparse or compressed data and other
//! files are refused by name. NaN is refused in both directions.

mod accessor;
mod json;
mod read;
mod textured;
mod write;

pub use read::{Glb, read_glb};
pub use textured::write_glb_textured;
pub use write::{write_glb_cloud, write_glb_mesh};

const FORMAT: &str = "GLB";
/// `glTF`, little-endian.
const MAGIC: u32 = 0x4654_6C67;
const VERSION: u32 = 2;
/// `JSON`
const CHUNK_JSON: u32 = 0x4E4F_534A;
/// `BIN\0`
const CHUNK_BIN: u32 = 0x004E_4942;

const UNSIGNED_BYTE: u32 = 5121;
const UNSIGNED_SHORT: u32 = 5123;
const UNSIGNED_INT: u32 = 5125;
const FLOAT: u32 = 5126;

const MODE_POINTS: u32 = 0;
const MODE_TRIANGLES: u32 = 4;

/// Key of `asset.extras` with the caller's comments.
const COMMENTS_KEY: &str = "comments";

/// sRGB byte to linear light, normalised 16 bits (IEC 61966-2-1).
fn linear_from_srgb(byte: u8) -> u16 {
    let s = f64::from(byte) / 255.0;
    let linear = if s <= 0.040_45 { s / 12.92 } else { ((s + 0.055) / 1.055).powf(2.4) };
    (linear * 65_535.0).round() as u16
}

/// Linear light in 0…1 to an sRGB byte; out of range saturates, NaN becomes 0.
fn srgb_from_linear(linear: f64) -> u8 {
    let s = if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
    (s * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_srgb_byte_survives_linear_sixteen_bits() {
        for byte in 0..=255 {
            assert_eq!(srgb_from_linear(f64::from(linear_from_srgb(byte)) / 65_535.0), byte);
        }
        // IEC 61966-2-1: mid grey 188 is half of the light.
        assert!((f64::from(linear_from_srgb(188)) / 65_535.0 - 0.5).abs() < 0.005);
        assert_eq!([srgb_from_linear(f64::NAN), srgb_from_linear(-1.0), srgb_from_linear(9.0)], [0, 0, 255]);
    }
}
