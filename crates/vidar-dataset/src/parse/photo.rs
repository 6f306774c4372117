//! EXIF of photographs: when they were taken, and the focal length.

use super::kitti::date_and_time;
use exif::{Exif, In, Tag, Value};
use std::io::Cursor;
use vidar_core::{Duration, Timestamp};

/// Diagonal of 35 mm film, mm; the equivalent focal length keeps the angle of view across the diagonal (CIPA DCG-001).
const FILM_DIAGONAL_MM: f64 = 43.266_615;

/// What a photograph states about itself.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhotoExif {
    /// Focal length as equivalent of 35 mm film, mm.
    pub focal_35mm: Option<f64>,
    /// When it was taken, by the camera's clock and time zone.
    pub time: Option<Timestamp>,
}

impl PhotoExif {
    /// Focal length in pixels of an image of this size.
    pub fn focal_px(&self, (width, height): (usize, usize)) -> Option<f64> {
        let diagonal = (width as f64).hypot(height as f64);
        self.focal_35mm.map(|mm| mm * diagonal / FILM_DIAGONAL_MM)
    }
}

/// Reads the EXIF at the beginning of an image file; what is not there or damaged is `None`.
pub fn photo_exif(head: &[u8]) -> PhotoExif {
    let Ok(exif) = exif::Reader::new().read_from_container(&mut Cursor::new(head)) else {
        return PhotoExif::default();
    };
    let focal = number(&exif, Tag::FocalLengthIn35mmFilm).filter(|mm| (1.0..=5000.0).contains(mm));
    PhotoExif { focal_35mm: focal, time: time(&exif) }
}

fn number(exif: &Exif, tag: Tag) -> Option<f64> {
    exif.get_field(tag, In::PRIMARY)?.value.get_uint(0).map(f64::from)
}

fn text(exif: &Exif, tag: Tag) -> Option<String> {
    match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Ascii(lines) => Some(String::from_utf8_lossy(lines.first()?).trim().to_string()),
        _ => None,
    }
}

/// `DateTimeOriginal` ("2024:03:01 12:30:05") with the digits after the point of its seconds.
fn time(exif: &Exif) -> Option<Timestamp> {
    let whole = date_and_time(&text(exif, Tag::DateTimeOriginal)?)?;
    let digits = text(exif, Tag::SubSecTimeOriginal).unwrap_or_default();
    let is_fraction = !digits.is_empty() && digits.len() <= 9 && digits.bytes().all(|b| b.is_ascii_digit());
    let nanos = if is_fraction { format!("{digits:0<9}").parse().unwrap_or(0) } else { 0 };
    Some(whole + Duration::from_nanos(nanos))
}
