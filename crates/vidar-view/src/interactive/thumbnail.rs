//! Small pictures of depth.

use crate::ViewError;
use crate::colormap::ColorMap;
use crate::picture::robust_range;
use vidar_core::Image;

/// A small picture of z-depth.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthThumbnail {
    /// PNG with a palette: the colours of [`crate::depth_picture`].
    pub png: Vec<u8>,
    /// Depth of the brightest colour, metres.
    pub near_m: f32,
    /// Depth of the darkest, metres.
    pub far_m: f32,
}

/// Every n-th pixel of a depth image, so that it is at most `columns` wide.
///
/// # Errors
/// [`ViewError::BadSize`] for an image without pixels, [`ViewError::Png`].
pub fn depth_thumbnail(depth: &Image<f32>, columns: usize) -> Result<DepthThumbnail, ViewError> {
    let valid = |z: f32| z.is_finite() && z > 0.0;
    let (near, far) = robust_range(depth, valid);
    let every = depth.width().div_ceil(columns.max(1)).max(1);
    let (width, height) = (depth.width() / every, depth.height() / every);
    if width == 0 || height == 0 {
        return Err(ViewError::BadSize { width, height, max: 65_535 });
    }
    // 255 is "no depth"; the other numbers are nearness.
    let shade = |z: f32| match valid(z) {
        true => (((far - z) / (far - near)).clamp(0.0, 1.0) * 254.0).round() as u8,
        false => 255,
    };
    let pixels: Vec<u8> = (0..height)
        .flat_map(|y| (0..width).map(move |x| (x * every, y * every)))
        .map(|at| shade(depth[at]))
        .collect();
    let palette: Vec<u8> = (0..=255_u8)
        .flat_map(|i| ColorMap::Sea.color(if i == 255 { f32::NAN } else { f32::from(i) / 254.0 }))
        .collect();
    let failed = |source| ViewError::Png { width, height, source };
    let mut png = Vec::new();
    let mut encoder = png::Encoder::new(&mut png, width as u32, height as u32);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_palette(palette);
    encoder.set_compression(png::Compression::High);
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(&pixels).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(DepthThumbnail { png, near_m: near, far_m: far })
}
