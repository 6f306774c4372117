//! Images of the caller.

use crate::error::usage;
use std::ffi::{CStr, c_char};
use vidar::Error;
use vidar::core::Image;

/// An image in the caller's memory: it is read during the call only.
#[repr(C)]
pub struct VidarImage {
    /// The first row; rows follow each other by `row_bytes`.
    pub pixels: *const u8,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes of a pixel: 1 is grey, 3 is red, green, blue.
    pub channels: u32,
    /// Bytes from one row to the next, at least `width * channels`.
    pub row_bytes: usize,
}

/// Largest side of an image, pixels: that of a camera model.
const MAX_SIDE: u32 = 65_535;

impl VidarImage {
    /// The rows, each of `width * channels` bytes.
    ///
    /// # Safety
    /// `pixels` points to `height` rows.
    unsafe fn rows(&self) -> Result<impl Iterator<Item = &[u8]>, Error> {
        let (width, height) = (self.width, self.height);
        let row = width as usize * self.channels as usize;
        let is_sized = (1..=MAX_SIDE).contains(&width) && (1..=MAX_SIDE).contains(&height);
        if self.pixels.is_null() || !is_sized || self.row_bytes < row {
            return Err(usage(format!(
                "an image of {width}x{height} pixels, {} channels and {} bytes a row",
                self.channels, self.row_bytes
            )));
        }
        // SAFETY: the caller's promise; each row lies inside the image.
        Ok((0..height as usize)
            .map(move |y| unsafe { std::slice::from_raw_parts(self.pixels.add(y * self.row_bytes), row) }))
    }

    /// Grey pixels, copied.
    ///
    /// # Safety
    /// As `VidarImage::rows`.
    pub unsafe fn gray(&self) -> Result<Image<u8>, Error> {
        if self.channels != 1 {
            return Err(usage(format!("{} channels, expected 1", self.channels)));
        }
        // SAFETY: the caller's promise.
        let data = unsafe { self.rows() }?.flatten().copied().collect();
        Image::from_vec(self.width as usize, self.height as usize, data).map_err(|e| usage(e.to_string()))
    }

    /// Colour pixels, copied; grey is repeated.
    ///
    /// # Safety
    /// As `VidarImage::rows`.
    pub unsafe fn rgb(&self) -> Result<Image<[u8; 3]>, Error> {
        // SAFETY: the caller's promise.
        let rows = unsafe { self.rows() }?;
        let data = match self.channels {
            1 => rows.flatten().map(|&g| [g; 3]).collect(),
            3 => rows.flat_map(|row| row.as_chunks::<3>().0).copied().collect(),
            other => return Err(usage(format!("{other} channels, expected 1 or 3"))),
        };
        Image::from_vec(self.width as usize, self.height as usize, data).map_err(|e| usage(e.to_string()))
    }
}

/// Text of the caller.
///
/// # Safety
/// `text` is null or ends in a zero byte, and lives as long as is said.
pub unsafe fn text<'a>(what: &str, text: *const c_char) -> Result<&'a str, Error> {
    if text.is_null() {
        return Err(usage(format!("{what} is null")));
    }
    // SAFETY: the caller's promise.
    unsafe { CStr::from_ptr(text) }.to_str().map_err(|_| usage(format!("{what} is not UTF-8")))
}
