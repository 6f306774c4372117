//! Images and planes of numbers as bytes.

use crate::envelope::within;
use crate::error::WireError;
use half::f16;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageFormat as Format, ImageReader, Limits};
use serde::{Deserialize, Serialize};
use std::io::Cursor;
use vidar_core::{FrameImage, Image};

/// The longest side of an image or plane, px.
pub(crate) const MAX_SIDE_PX: usize = 8192;
/// Quality of JPEG, 1 to 100: visually lossless for a network, a tenth of the bytes.
const JPEG_QUALITY: u8 = 92;

/// How images travel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ImageFormat {
    /// As they are: the worker sees the same bits.
    #[default]
    Raw,
    /// As JPEG of quality 92: about a tenth of the bytes, other bits.
    Jpeg,
}

/// How depth, confidence and tokens travel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DepthFormat {
    /// 32 bits, as predicted.
    #[default]
    F32,
    /// 16 bits, rounded: half the bytes, a relative error of at most 5e-4.
    F16,
}

/// What the bytes of an image are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum PixelFormat {
    Gray8,
    Gray16,
    Rgb8,
    GrayJpeg,
    RgbJpeg,
}

impl DepthFormat {
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 => 2,
        }
    }

    pub(crate) fn put(self, values: &[f32], out: &mut Vec<u8>) {
        match self {
            Self::F32 => values.iter().for_each(|v| out.extend(v.to_le_bytes())),
            Self::F16 => values.iter().for_each(|v| out.extend(f16::from_f32(*v).to_le_bytes())),
        }
    }

    pub(crate) fn take(self, bytes: &[u8]) -> Vec<f32> {
        match self {
            Self::F32 => {
                bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
            }
            Self::F16 => bytes.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]]).to_f32()).collect(),
        }
    }
}

/// An image as bytes. 16 bits do not fit into JPEG and travel as they are.
pub(crate) fn encode(
    image: &FrameImage,
    as_format: ImageFormat,
) -> Result<(PixelFormat, Vec<u8>), WireError> {
    let (width, height) = (image.width(), image.height());
    Ok(match (image, as_format) {
        (FrameImage::Gray16(i), _) => {
            (PixelFormat::Gray16, i.data().iter().flat_map(|v| v.to_le_bytes()).collect())
        }
        (FrameImage::Gray8(i), ImageFormat::Raw) => (PixelFormat::Gray8, i.data().to_vec()),
        (FrameImage::Rgb8(i), ImageFormat::Raw) => (PixelFormat::Rgb8, i.data().as_flattened().to_vec()),
        (FrameImage::Gray8(i), ImageFormat::Jpeg) => {
            (PixelFormat::GrayJpeg, jpeg(i.data(), (width, height), ExtendedColorType::L8)?)
        }
        (FrameImage::Rgb8(i), ImageFormat::Jpeg) => {
            let data = i.data().as_flattened();
            (PixelFormat::RgbJpeg, jpeg(data, (width, height), ExtendedColorType::Rgb8)?)
        }
    })
}

fn jpeg(
    data: &[u8],
    (width, height): (usize, usize),
    color: ExtendedColorType,
) -> Result<Vec<u8>, WireError> {
    within("width of an image", width, MAX_SIDE_PX)?;
    within("height of an image", height, MAX_SIDE_PX)?;
    let mut bytes = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY);
    let encoded = image::ImageEncoder::write_image(encoder, data, width as u32, height as u32, color);
    encoded.map(|()| bytes).map_err(|e| WireError::bad("image", e))
}

/// An image of the announced size; anything else is refused before pixels are allocated.
pub(crate) fn decode(
    format: PixelFormat,
    (width, height): (usize, usize),
    bytes: &[u8],
) -> Result<FrameImage, WireError> {
    let per_pixel = match format {
        PixelFormat::Gray8 => 1,
        PixelFormat::Gray16 => 2,
        PixelFormat::Rgb8 => 3,
        PixelFormat::GrayJpeg | PixelFormat::RgbJpeg => return decode_jpeg(format, (width, height), bytes),
    };
    let expected = width * height * per_pixel;
    if bytes.len() != expected {
        return Err(WireError::Length { what: "image", found: bytes.len(), expected });
    }
    let bad = |e: vidar_core::ImageError| WireError::bad("image", e);
    Ok(match format {
        PixelFormat::Gray16 => {
            let data = bytes.chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]])).collect();
            FrameImage::Gray16(Image::from_vec(width, height, data).map_err(bad)?)
        }
        PixelFormat::Rgb8 => {
            let data = bytes.as_chunks::<3>().0.to_vec();
            FrameImage::Rgb8(Image::from_vec(width, height, data).map_err(bad)?)
        }
        _ => FrameImage::Gray8(Image::from_vec(width, height, bytes.to_vec()).map_err(bad)?),
    })
}

fn decode_jpeg(
    format: PixelFormat,
    (width, height): (usize, usize),
    bytes: &[u8],
) -> Result<FrameImage, WireError> {
    let bad = |e: image::ImageError| WireError::bad("image", e);
    let found = ImageReader::with_format(Cursor::new(bytes), Format::Jpeg).into_dimensions().map_err(bad)?;
    if found != (width as u32, height as u32) {
        let reason = format!("{}x{} px, announced {width}x{height}", found.0, found.1);
        return Err(WireError::bad("image", reason));
    }
    let mut reader = ImageReader::with_format(Cursor::new(bytes), Format::Jpeg);
    let mut limits = Limits::default();
    limits.max_alloc = Some((width * height * 8 + (1 << 20)) as u64);
    reader.limits(limits);
    let decoded = reader.decode().map_err(bad)?;
    let wrong = |e: vidar_core::ImageError| WireError::bad("image", e);
    Ok(match format {
        PixelFormat::GrayJpeg => {
            let data = decoded.into_luma8().into_raw();
            FrameImage::Gray8(Image::from_vec(width, height, data).map_err(wrong)?)
        }
        _ => {
            let data = decoded.into_rgb8().into_raw().as_chunks::<3>().0.to_vec();
            FrameImage::Rgb8(Image::from_vec(width, height, data).map_err(wrong)?)
        }
    })
}
