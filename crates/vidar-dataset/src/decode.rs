//! Pixels from PNG and JPEG files of unknown origin.
//!
//! The header is checked before a pixel is allocated: each side, the number of decoded bytes and, for PNG, the largest
//! size that the compressed bytes can inflate to. A JPEG without end-of-image marker is refused: the decoder would fill
//! the rest with grey, which a stereo matcher would take for image content.

use crate::error::DatasetError;
use crate::isolated::isolated;
use crate::source::read_file_up_to;
use image::metadata::Orientation;
use image::{ColorType, DynamicImage, ImageDecoder};
use std::io::Cursor;
use std::path::Path;
use vidar_core::{FrameImage, Image};

/// Limits on what an image is decoded to. Files are read with the default; tests on hostile bytes allow less, to go through
/// thousands of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageLimits {
    /// Largest width and height, pixels.
    pub max_side_px: u32,
    /// Largest decoded size, bytes.
    pub max_decoded_bytes: u64,
}

impl Default for ImageLimits {
    fn default() -> Self {
        Self { max_side_px: 16_384, max_decoded_bytes: 512 << 20 }
    }
}

/// Largest image file that is read, bytes: as much as an image may be decoded to.
const MAX_FILE_BYTES: u64 = 512 << 20;

/// Deflate never expands a byte to more than this many (RFC 1951: 258 bytes from a little over 2 bits).
const DEFLATE_MAX_EXPANSION: u64 = 1032;

/// Reads an image file as grey or colour; alpha is dropped, palettes and 1/2/4-bit grey are expanded, 16-bit
/// colour is rounded to 8 bits. A photograph is turned upright as its EXIF says.
pub fn read_image(path: &Path) -> Result<FrameImage, DatasetError> {
    let bytes = read_file_up_to(path, MAX_FILE_BYTES)?;
    isolated(|| decode_image(&bytes, &ImageLimits::default())).map_err(|reason| bad_image(path, reason))
}

/// Reads a 16-bit grey PNG of raw depths (8-bit grey is widened, value for value).
pub fn read_depth(path: &Path) -> Result<Image<u16>, DatasetError> {
    match read_image(path)? {
        FrameImage::Gray16(raw) => Ok(raw),
        FrameImage::Gray8(raw) => Ok(raw.map(|&v| u16::from(v))),
        _ => Err(bad_image(path, "a depth image must be 16-bit grey, found colour".into())),
    }
}

/// The size in the header of an image file, columns and rows, upright.
pub fn read_size(path: &Path) -> Result<(usize, usize), DatasetError> {
    // Headers may follow kilobytes of metadata, so the decoder decides how much it reads.
    let bytes = read_file_up_to(path, MAX_FILE_BYTES)?;
    isolated(|| {
        let mut decoder = open_decoder(&bytes, &ImageLimits::default())?;
        let (width, height) = decoder.dimensions();
        let (width, height) = (width as usize, height as usize);
        Ok(if lies_on_its_side(orientation(decoder.as_mut())) { (height, width) } else { (width, height) })
    })
    .map_err(|reason| bad_image(path, reason))
}

/// How the picture is to be turned; not at all where its EXIF is damaged.
fn orientation(decoder: &mut dyn ImageDecoder) -> Orientation {
    decoder.orientation().unwrap_or(Orientation::NoTransforms)
}

fn lies_on_its_side(orientation: Orientation) -> bool {
    use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
    matches!(orientation, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH)
}

fn bad_image(path: &Path, reason: String) -> DatasetError {
    DatasetError::BadImage { path: path.to_path_buf(), reason }
}

enum Format {
    Png,
    Jpeg,
}

fn format_of(bytes: &[u8]) -> Result<Format, String> {
    match bytes {
        [] => Err("the file is empty (0 bytes)".into()),
        [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a, ..] => Ok(Format::Png),
        [0xff, 0xd8, 0xff, ..] => Ok(Format::Jpeg),
        _ => Err(format!(
            "neither PNG nor JPEG: the first bytes are {:02x?}",
            bytes.get(..8.min(bytes.len())).unwrap_or_default()
        )),
    }
}

/// A decoder whose header was checked against the limits.
fn open_decoder<'a>(bytes: &'a [u8], limits: &ImageLimits) -> Result<Box<dyn ImageDecoder + 'a>, String> {
    let mut image_limits = image::Limits::default();
    image_limits.max_image_width = Some(limits.max_side_px);
    image_limits.max_image_height = Some(limits.max_side_px);
    image_limits.max_alloc = Some(limits.max_decoded_bytes);
    let format = format_of(bytes)?;
    let mut decoder: Box<dyn ImageDecoder + 'a> = match format {
        Format::Png => {
            check_png_palette(bytes)?;
            let decoder =
                image::codecs::png::PngDecoder::with_limits(Cursor::new(bytes), image_limits.clone());
            Box::new(decoder.map_err(|e| e.to_string())?)
        }
        Format::Jpeg => {
            let decoder = image::codecs::jpeg::JpegDecoder::new(Cursor::new(bytes));
            Box::new(decoder.map_err(|e| e.to_string())?)
        }
    };
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 {
        return Err(format!("the header says {width}x{height} pixels"));
    }
    if width > limits.max_side_px || height > limits.max_side_px {
        let limit = limits.max_side_px;
        return Err(format!("the header says {width}x{height} pixels; the limit is {limit} a side"));
    }
    let decoded = decoder.total_bytes();
    if decoded > limits.max_decoded_bytes {
        let limit = limits.max_decoded_bytes;
        return Err(format!("{width}x{height} pixels need {decoded} bytes; the limit is {limit}"));
    }
    // EXPAND turns 1-bit grey into 8-bit and palettes into colour: at most 24 times what deflate delivers.
    if matches!(format, Format::Png)
        && decoded / 24 > (bytes.len() as u64).saturating_mul(DEFLATE_MAX_EXPANSION)
    {
        return Err(format!(
            "the header says {width}x{height} pixels, more than {} bytes can hold (truncated?)",
            bytes.len()
        ));
    }
    decoder.set_limits(image_limits).map_err(|e| e.to_string())?;
    Ok(decoder)
}

/// Decodes a PNG or JPEG held in memory; the error is the reason as text.
pub fn decode_image(bytes: &[u8], limits: &ImageLimits) -> Result<FrameImage, String> {
    if matches!(format_of(bytes)?, Format::Jpeg) && !jpeg_is_complete(bytes) {
        return Err(format!("truncated: {} bytes of JPEG without an end-of-image marker", bytes.len()));
    }
    let mut decoder = open_decoder(bytes, limits)?;
    let (color, turn) = (decoder.color_type(), orientation(decoder.as_mut()));
    let mut decoded = DynamicImage::from_decoder(decoder).map_err(|e| {
        let text = e.to_string();
        if text.to_lowercase().contains("eof") || text.contains("end of file") || text.contains("end of data")
        {
            format!("truncated: {text}")
        } else {
            text
        }
    })?;
    decoded.apply_orientation(turn);
    to_frame_image(color, decoded)
}

fn to_frame_image(color: ColorType, decoded: DynamicImage) -> Result<FrameImage, String> {
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    let sized = |e: vidar_core::ImageError| e.to_string();
    match color {
        ColorType::L8 | ColorType::La8 => Image::from_vec(width, height, decoded.into_luma8().into_raw())
            .map(FrameImage::Gray8)
            .map_err(sized),
        ColorType::L16 | ColorType::La16 => Image::from_vec(width, height, decoded.into_luma16().into_raw())
            .map(FrameImage::Gray16)
            .map_err(sized),
        _ => {
            let raw = decoded.into_rgb8().into_raw();
            let (pixels, _) = raw.as_chunks::<3>();
            Image::from_vec(width, height, pixels.to_vec()).map(FrameImage::Rgb8).map_err(sized)
        }
    }
}

/// Refuses palettes whose length is no whole number of colours, and lists of transparencies longer than the
/// palette: the decoder (png 0.18.1) indexes past the end of both and panics. Found by fuzzing.
fn check_png_palette(bytes: &[u8]) -> Result<(), String> {
    let mut at = 8usize;
    let mut colours = None;
    while let Some((length, kind)) = bytes
        .get(at..)
        .and_then(|b| b.split_first_chunk::<4>())
        .and_then(|(length, rest)| Some((u32::from_be_bytes(*length) as usize, *rest.first_chunk::<4>()?)))
    {
        if kind == *b"PLTE" && (length % 3 != 0 || length > 768) {
            return Err(format!("a palette of {length} bytes; it must hold 1 to 256 colours of 3 bytes"));
        }
        if kind == *b"PLTE" {
            colours = Some(length / 3);
        }
        // Byte 25 is the header's colour type; 3 is "by palette".
        if kind == *b"tRNS" && bytes.get(25) == Some(&3) && colours.is_some_and(|n| length > n) {
            return Err(format!(
                "{length} transparencies for {} colours of the palette",
                colours.unwrap_or(0)
            ));
        }
        if kind == *b"IEND" {
            break;
        }
        // Length, kind and checksum take 12 bytes.
        at = at.saturating_add(12).saturating_add(length);
    }
    Ok(())
}

/// Whether the segments of a JPEG lead to an end-of-image marker.
fn jpeg_is_complete(bytes: &[u8]) -> bool {
    let mut at = 2;
    while let Some(&[first, marker]) = bytes.get(at..at + 2) {
        match (first, marker) {
            (0xff, 0xd9) => return true,
            // Fill bytes, restart markers and TEM carry no length.
            (0xff, 0xff) => at += 1,
            (0xff, 0x01 | 0xd0..=0xd8) => at += 2,
            // Entropy-coded data: stuffed zero bytes and everything that is no marker.
            (0xff, 0x00) => at += 2,
            (0xff, _) => {
                let Some(&[high, low]) = bytes.get(at + 2..at + 4) else { return false };
                at += 2 + usize::from(u16::from_be_bytes([high, low])).max(2);
            }
            _ => at += 1,
        }
    }
    false
}

#[cfg(test)]
mod tests;
