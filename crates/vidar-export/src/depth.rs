//! 16-bit depth PNG with a JSON sidecar that defines scale, camera and poses.
//!
//! A pixel is `round(z · units_per_metre)`; 0 means no depth. Depths out of range (above 65535 units, below
//! half a unit) are written as 0 and counted: a clamped depth would be a false wall. NaN in memory becomes 0 and
//! 0 becomes NaN again.

use crate::error::{ExportError, write_error};
use serde::{Deserialize, Serialize};
use std::io::{self, Cursor, Write};
use vidar_core::{FrameId, Image, MetricDepth, Pinhole, Se3, So3, Timestamp};

const FORMAT: &str = "depth PNG";
const SIDECAR_FORMAT: &str = "depth sidecar";

/// Millimetres: the scale RGB-D tools expect, 0 to 65.5 m.
pub const MILLIMETRES: f64 = 1000.0;
/// The TUM RGB-D benchmark's scale, 0 to 13.1 m.
pub const TUM_SCALE: f64 = 5000.0;

/// Largest image read, pixels: 16384², above every sensor; a limit for files with a wrong header.
const MAX_PIXELS: u64 = 1 << 28;

/// Counts of the pixels of a written depth image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DepthPngStats {
    /// Pixels with a depth in the file.
    pub written: usize,
    /// Pixels that had no depth.
    pub invalid: usize,
    /// Pixels whose depth is out of the range of the scale; written as invalid.
    pub clipped: usize,
}

/// Writes z-depth as a 16-bit grey PNG with `units_per_metre` steps per metre ([`MILLIMETRES`], [`TUM_SCALE`]).
pub fn write_depth_png(
    w: impl Write,
    depth: &MetricDepth,
    units_per_metre: f64,
) -> Result<DepthPngStats, ExportError> {
    check_units(FORMAT, units_per_metre)?;
    let image = depth.image();
    let (Ok(width), Ok(height)) = (u32::try_from(image.width()), u32::try_from(image.height())) else {
        return Err(ExportError::unwritable(FORMAT, "the image", "a side exceeds 32 bits"));
    };
    if width == 0 || height == 0 {
        return Err(ExportError::unwritable(FORMAT, "the image", "it has no pixels"));
    }
    let mut stats = DepthPngStats::default();
    let mut data = Vec::with_capacity(image.data().len() * 2);
    for z in image.data() {
        data.extend_from_slice(&quantised(*z, units_per_metre, &mut stats).to_be_bytes());
    }
    write_gray16(w, width, height, &data).map_err(write_error(FORMAT))?;
    Ok(stats)
}

fn quantised(z: f32, units_per_metre: f64, stats: &mut DepthPngStats) -> u16 {
    if z.is_nan() {
        stats.invalid += 1;
        return 0;
    }
    let units = (f64::from(z) * units_per_metre).round();
    if (1.0..=65_535.0).contains(&units) {
        stats.written += 1;
        units as u16
    } else {
        stats.clipped += 1;
        0
    }
}

fn write_gray16(mut w: impl Write, width: u32, height: u32, big_endian: &[u8]) -> io::Result<()> {
    encode_gray16(&mut w, width, height, big_endian).map_err(|error| match error {
        // The encoder's own conversion hides the system's reason (a full device) behind "other".
        png::EncodingError::IoError(source) => source,
        other => io::Error::other(other),
    })?;
    w.flush()
}

fn encode_gray16(
    w: impl Write,
    width: u32,
    height: u32,
    big_endian: &[u8],
) -> Result<(), png::EncodingError> {
    let mut encoder = png::Encoder::new(w, width, height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    // A depth image of 480×360: 1.6 ms, not 48, for 7 % more bytes.
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(big_endian)?;
    writer.finish()
}

/// Reads a 16-bit grey PNG as z-depth, given its scale.
pub fn read_depth_png(bytes: &[u8], units_per_metre: f64) -> Result<MetricDepth, ExportError> {
    check_units(FORMAT, units_per_metre)?;
    let broken = |error: png::DecodingError| {
        ExportError::malformed(
            FORMAT,
            format!("file of {} bytes", bytes.len()),
            "a PNG image",
            error.to_string(),
        )
    };
    let mut reader = png::Decoder::new(Cursor::new(bytes)).read_info().map_err(broken)?;
    let info = reader.info();
    let (width, height) = (info.width, info.height);
    if (info.color_type, info.bit_depth) != (png::ColorType::Grayscale, png::BitDepth::Sixteen) {
        let found = format!("{:?} of {:?} bits", info.color_type, info.bit_depth);
        return Err(ExportError::malformed(FORMAT, "header", "16-bit grey", found));
    }
    if info.interlaced {
        return Err(ExportError::malformed(FORMAT, "header", "rows in order", "an interlaced image"));
    }
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        let found = format!("{width}x{height}");
        return Err(ExportError::malformed(FORMAT, "header", format!("at most {MAX_PIXELS} pixels"), found));
    }
    // Rows are appended as they are decoded, so a wrong header costs no memory.
    let mut depths = Vec::new();
    while let Some(row) = reader.next_row().map_err(broken)? {
        depths.extend(row.data().chunks_exact(2).map(|b| match u16::from_be_bytes([b[0], b[1]]) {
            0 => f32::NAN,
            units => (f64::from(units) / units_per_metre) as f32,
        }));
    }
    reader.finish().map_err(broken)?;
    let image = Image::from_vec(width as usize, height as usize, depths)
        .map_err(|error| ExportError::malformed(FORMAT, "pixels", "a full image", error.to_string()))?;
    Ok(MetricDepth::new(image))
}

fn check_units(format: &'static str, units_per_metre: f64) -> Result<(), ExportError> {
    if units_per_metre.is_finite() && units_per_metre > 0.0 {
        return Ok(());
    }
    let reason = "it must be finite and positive";
    Err(ExportError::unwritable(format, format!("a scale of {units_per_metre} units per metre"), reason))
}

/// The JSON sidecar of a folder of depth images: scale, camera and poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthSidecar {
    /// Name and version of this layout: [`DepthSidecar::SCHEMA`].
    pub schema: String,
    /// Steps per metre: `metres = pixel / scale`.
    pub scale: f64,
    /// `z`: distance along the optical axis, not along the ray.
    pub kind: DepthKind,
    /// The unit of length; always metres.
    pub unit: LengthUnit,
    /// The pixel value that means "no depth"; always 0.
    pub invalid: u16,
    /// Columns of every image.
    pub width: usize,
    /// Rows of every image.
    pub height: usize,
    /// Intrinsics of every image; the centre of the top-left pixel is (0, 0).
    pub intrinsics: SidecarIntrinsics,
    /// The images.
    pub frames: Vec<DepthFrame>,
}

/// The direction along which depth is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthKind {
    /// The optical axis.
    Z,
}

/// The unit of length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LengthUnit {
    /// Metres.
    Metre,
}

/// Pinhole parameters, pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SidecarIntrinsics {
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
}

/// One depth image of a folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthFrame {
    /// File name, relative to the sidecar.
    pub file: String,
    /// Which frame.
    pub frame_id: FrameId,
    /// When it was taken, nanoseconds of the dataset's clock.
    pub time_ns: Timestamp,
    /// Position of the camera in the world, metres.
    pub translation_m: [f64; 3],
    /// Rotation `world_from_camera` as a unit quaternion x, y, z, w.
    pub rotation_xyzw: [f64; 4],
}

impl DepthFrame {
    /// Describes the image `file` of a frame.
    pub fn new(file: impl Into<String>, frame_id: FrameId, time: Timestamp, world_from_camera: &Se3) -> Self {
        Self {
            file: file.into(),
            frame_id,
            time_ns: time,
            translation_m: world_from_camera.translation.into(),
            rotation_xyzw: world_from_camera.rotation.quaternion_xyzw(),
        }
    }

    /// Where the camera was; `None` when the quaternion is not of unit length (within 1 %) or not finite.
    pub fn world_from_camera(&self) -> Option<Se3> {
        let [x, y, z, w] = self.rotation_xyzw;
        let length = (x * x + y * y + z * z + w * w).sqrt();
        let transform = Se3::new(So3::from_quaternion(x, y, z, w)?, self.translation_m.into());
        ((length - 1.0).abs() < 1e-2 && transform.is_finite()).then_some(transform)
    }
}

impl DepthSidecar {
    /// The layout written and read by this version.
    pub const SCHEMA: &'static str = "vidar.depth/1";

    /// Describes depth images of one camera.
    pub fn new(units_per_metre: f64, intrinsics: &Pinhole, frames: Vec<DepthFrame>) -> Self {
        Self {
            schema: Self::SCHEMA.to_owned(),
            scale: units_per_metre,
            kind: DepthKind::Z,
            unit: LengthUnit::Metre,
            invalid: 0,
            width: intrinsics.width,
            height: intrinsics.height,
            intrinsics: SidecarIntrinsics {
                fx: intrinsics.fx,
                fy: intrinsics.fy,
                cx: intrinsics.cx,
                cy: intrinsics.cy,
            },
            frames,
        }
    }

    /// Writes the sidecar as indented JSON.
    pub fn write(&self, mut w: impl Write) -> Result<(), ExportError> {
        if let Err((place, expected, found)) = self.check() {
            return Err(ExportError::unwritable(
                SIDECAR_FORMAT,
                place,
                format!("{expected} wanted, {found} found"),
            ));
        }
        serde_json::to_writer_pretty(&mut w, self)
            .map_err(io::Error::from)
            .and_then(|()| writeln!(w))
            .and_then(|()| w.flush())
            .map_err(write_error(SIDECAR_FORMAT))
    }

    /// Reads a sidecar and checks every value.
    pub fn read(bytes: &[u8]) -> Result<Self, ExportError> {
        let sidecar: Self = crate::json::parse(SIDECAR_FORMAT, bytes)?;
        match sidecar.check() {
            Ok(()) => Ok(sidecar),
            Err((place, expected, found)) => {
                Err(ExportError::malformed(SIDECAR_FORMAT, place, expected, found))
            }
        }
    }

    /// The intrinsics with their size.
    pub fn pinhole(&self) -> Result<Pinhole, vidar_core::CameraError> {
        let k = &self.intrinsics;
        Pinhole::new(k.fx, k.fy, k.cx, k.cy, self.width, self.height)
    }

    fn check(&self) -> Result<(), (String, String, String)> {
        let wrong =
            |place: &str, expected: &str, found: String| Err((place.to_owned(), expected.to_owned(), found));
        if self.schema != Self::SCHEMA {
            return wrong("schema", Self::SCHEMA, crate::error::quoted(&self.schema));
        }
        if !(self.scale.is_finite() && self.scale > 0.0) {
            return wrong("scale", "a finite, positive number", self.scale.to_string());
        }
        if self.invalid != 0 {
            return wrong("invalid", "0", self.invalid.to_string());
        }
        if let Err(error) = self.pinhole() {
            return wrong("intrinsics", "a pinhole camera", error.to_string());
        }
        for (i, frame) in self.frames.iter().enumerate() {
            if frame.file.is_empty() {
                return wrong(&format!("frames[{i}].file"), "a file name", "none".to_owned());
            }
            if frame.world_from_camera().is_none() {
                let found = format!("{:?}, {:?}", frame.translation_m, frame.rotation_xyzw);
                return wrong(&format!("frames[{i}]"), "a finite position and a unit quaternion", found);
            }
        }
        Ok(())
    }
}
