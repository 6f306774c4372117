//! Pictures as PNG bytes.

use crate::{Picture, ViewError};

/// Largest side this writes; PNG allows 2³¹−1, readers much less.
const MAX_SIDE: usize = 65_535;

/// A picture as an 8-bit sRGB PNG file.
///
/// # Errors
/// [`ViewError::BadSize`] for a picture without pixels or with a side above 65535.
pub fn encode_png(picture: &Picture) -> Result<Vec<u8>, ViewError> {
    let (width, height) = (picture.width(), picture.height());
    let side = 1..=MAX_SIDE;
    if !side.contains(&width) || !side.contains(&height) {
        return Err(ViewError::BadSize { width, height, max: MAX_SIDE });
    }
    let refused = |source| ViewError::Png { width, height, source };
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width as u32, height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    // A picture of a report: 3 ms, not 70, for 4 % more bytes.
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header().map_err(refused)?;
    writer.write_image_data(picture.data().as_flattened()).map_err(refused)?;
    writer.finish().map_err(refused)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_png_decodes_to_the_same_pixels() {
        let picture = Picture::from_fn(37, 21, |x, y| [(x * 7) as u8, (y * 11) as u8, (x * y) as u8]);
        let bytes = encode_png(&picture).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        assert_eq!((info.width, info.height), (37, 21));
        assert_eq!((info.color_type, info.bit_depth), (png::ColorType::Rgb, png::BitDepth::Eight));
        assert_eq!(pixels, picture.data().as_flattened());
    }

    #[test]
    fn a_picture_without_pixels_is_refused_with_its_size() {
        let error = encode_png(&Picture::filled(0, 5, [0; 3])).unwrap_err();
        assert!(error.to_string().contains("0x5"), "{error}");
    }
}
