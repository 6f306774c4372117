//! Row-major images that own their pixels.

use thiserror::Error;

/// A row-major image; pixel `(x, y)` lies at `y * width + x`.
#[derive(Clone, Debug, PartialEq)]
pub struct Image<P> {
    width: usize,
    height: usize,
    data: Vec<P>,
}

/// Why an image cannot be made.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ImageError {
    /// The number of pixels does not fit the size.
    #[error("image of {width}x{height} needs {expected} pixels, found {found}")]
    WrongLength {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// `width * height`.
        expected: usize,
        /// Length of the data given.
        found: usize,
    },
    /// `width * height` does not fit the address space.
    #[error("image of {width}x{height} pixels is too large")]
    TooLarge {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
}

impl<P> Image<P> {
    /// Takes `data` as the pixels of a `width` × `height` image.
    pub fn from_vec(width: usize, height: usize, data: Vec<P>) -> Result<Self, ImageError> {
        let expected = width.checked_mul(height).ok_or(ImageError::TooLarge { width, height })?;
        if data.len() != expected {
            return Err(ImageError::WrongLength { width, height, expected, found: data.len() });
        }
        Ok(Self { width, height, data })
    }

    /// Fills an image from a function of column and row.
    pub fn from_fn(width: usize, height: usize, mut pixel: impl FnMut(usize, usize) -> P) -> Self {
        let mut data = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                data.push(pixel(x, y));
            }
        }
        Self { width, height, data }
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels, row by row.
    pub fn data(&self) -> &[P] {
        &self.data
    }

    /// All pixels, row by row.
    pub fn data_mut(&mut self) -> &mut [P] {
        &mut self.data
    }

    /// The pixels, row by row, without the image.
    pub fn into_vec(self) -> Vec<P> {
        self.data
    }

    /// One row.
    pub fn row(&self, y: usize) -> &[P] {
        &self.data[y * self.width..(y + 1) * self.width]
    }

    /// The pixel at column `x`, row `y`, or `None` outside.
    pub fn get(&self, x: usize, y: usize) -> Option<&P> {
        if x < self.width && y < self.height { self.data.get(y * self.width + x) } else { None }
    }

    /// The same image with `f` applied to every pixel.
    pub fn map<Q>(&self, f: impl FnMut(&P) -> Q) -> Image<Q> {
        Image { width: self.width, height: self.height, data: self.data.iter().map(f).collect() }
    }
}

impl<P: Clone> Image<P> {
    /// An image of one value.
    pub fn filled(width: usize, height: usize, value: P) -> Self {
        Self { width, height, data: vec![value; width * height] }
    }
}

impl<P> std::ops::Index<(usize, usize)> for Image<P> {
    type Output = P;
    /// Pixel `(x, y)`; panics outside, as slices do.
    fn index(&self, (x, y): (usize, usize)) -> &P {
        debug_assert!(x < self.width);
        &self.data[y * self.width + x]
    }
}

impl<P> std::ops::IndexMut<(usize, usize)> for Image<P> {
    fn index_mut(&mut self, (x, y): (usize, usize)) -> &mut P {
        debug_assert!(x < self.width);
        &mut self.data[y * self.width + x]
    }
}

/// An image as a camera delivered it.
#[derive(Clone, Debug, PartialEq)]
pub enum FrameImage {
    /// 8-bit grey.
    Gray8(Image<u8>),
    /// 16-bit grey.
    Gray16(Image<u16>),
    /// 8-bit red, green, blue.
    Rgb8(Image<[u8; 3]>),
}

impl FrameImage {
    /// Columns.
    pub fn width(&self) -> usize {
        match self {
            Self::Gray8(i) => i.width(),
            Self::Gray16(i) => i.width(),
            Self::Rgb8(i) => i.width(),
        }
    }

    /// Rows.
    pub fn height(&self) -> usize {
        match self {
            Self::Gray8(i) => i.height(),
            Self::Gray16(i) => i.height(),
            Self::Rgb8(i) => i.height(),
        }
    }

    /// Grey levels as `f32` in 0…255 (BT.601 luma for colour; 16-bit divided by 257).
    pub fn to_gray_f32(&self) -> Image<f32> {
        match self {
            Self::Gray8(i) => i.map(|&p| f32::from(p)),
            Self::Gray16(i) => i.map(|&p| f32::from(p) / 257.0),
            Self::Rgb8(i) => i.map(luma),
        }
    }

    /// Grey levels as `u8`, rounded.
    pub fn to_gray8(&self) -> Image<u8> {
        match self {
            Self::Gray8(i) => i.clone(),
            Self::Gray16(i) => i.map(|&p| ((u32::from(p) + 128) / 257) as u8),
            Self::Rgb8(i) => i.map(|p| luma(p).round() as u8),
        }
    }

    /// Red, green, blue; grey repeated for grey images.
    pub fn to_rgb8(&self) -> Image<[u8; 3]> {
        match self {
            Self::Rgb8(i) => i.clone(),
            other => other.to_gray8().map(|&g| [g; 3]),
        }
    }
}

fn luma(p: &[u8; 3]) -> f32 {
    0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2])
}
