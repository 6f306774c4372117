//! Grey PNG and JPEG files.

use crate::error::SynthError;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

/// Writes 8-bit grey pixels as a baseline JPEG of `quality` 1…100.
pub(crate) fn write_jpeg(
    path: &Path,
    width: usize,
    height: usize,
    pixels: &[u8],
    quality: u8,
) -> Result<(), SynthError> {
    let mut bytes = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality)
        .encode(pixels, width as u32, height as u32, image::ExtendedColorType::L8)
        .map_err(std::io::Error::other)
        .and_then(|()| std::fs::write(path, &bytes))
        .map_err(SynthError::write(path))
}

/// Writes 8-bit grey pixels.
pub(crate) fn write_gray8(path: &Path, width: usize, height: usize, pixels: &[u8]) -> Result<(), SynthError> {
    write(path, width, height, png::BitDepth::Eight, pixels)
}

/// Writes 16-bit grey pixels.
pub(crate) fn write_gray16(
    path: &Path,
    width: usize,
    height: usize,
    pixels: &[u16],
) -> Result<(), SynthError> {
    let bytes: Vec<u8> = pixels.iter().flat_map(|p| p.to_be_bytes()).collect();
    write(path, width, height, png::BitDepth::Sixteen, &bytes)
}

fn write(
    path: &Path,
    width: usize,
    height: usize,
    depth: png::BitDepth,
    bytes: &[u8],
) -> Result<(), SynthError> {
    encode(path, width, height, depth, bytes).map_err(SynthError::write(path))
}

fn encode(
    path: &Path,
    width: usize,
    height: usize,
    depth: png::BitDepth,
    bytes: &[u8],
) -> std::io::Result<()> {
    let mut file = BufWriter::new(File::create(path)?);
    let mut encoder = png::Encoder::new(&mut file, width as u32, height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(depth);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header().map_err(io_error)?;
    writer.write_image_data(bytes).map_err(io_error)?;
    writer.finish().map_err(io_error)?;
    // A full disk shows only when the last bytes leave the buffer.
    file.flush()
}

fn io_error(error: png::EncodingError) -> std::io::Error {
    match error {
        png::EncodingError::IoError(e) => e,
        other => std::io::Error::other(other),
    }
}
