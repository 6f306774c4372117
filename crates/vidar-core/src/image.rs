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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_lie_row_by_row() {
        let image = Image::from_fn(3, 2, |x, y| 10 * y + x);
        assert_eq!(image.data(), &[0, 1, 2, 10, 11, 12]);
        assert_eq!((image.width(), image.height(), image.row(1)), (3, 2, &[10, 11, 12][..]));
        assert_eq!(
            (image[(2, 1)], image.get(2, 1), image.get(3, 0), image.get(0, 2)),
            (12, Some(&12), None, None)
        );
        assert_eq!(image.map(|v| v * 2).into_vec(), [0, 2, 4, 20, 22, 24]);
        let mut changed = image.clone();
        changed[(1, 1)] = 99;
        changed.data_mut()[0] = 98;
        assert_eq!(changed.into_vec(), [98, 1, 2, 10, 99, 12]);
    }

    #[test]
    fn pixels_that_do_not_fit_the_size_are_refused() {
        let wrong = ImageError::WrongLength { width: 3, height: 2, expected: 6, found: 5 };
        assert_eq!(Image::from_vec(3, 2, vec![0; 5]), Err(wrong));
        let (width, height) = (usize::MAX, 2);
        assert_eq!(Image::<u8>::from_vec(width, height, vec![]), Err(ImageError::TooLarge { width, height }));
        assert!(Image::from_vec(0, 7, Vec::<u8>::new()).is_ok());
    }

    #[test]
    fn grey_levels_keep_black_white_and_luma() {
        let deep = FrameImage::Gray16(Image::from_vec(4, 1, vec![0, 257, 32_896, 65_535]).unwrap());
        assert_eq!(deep.to_gray8().data(), &[0, 1, 128, 255]);
        assert_eq!(deep.to_gray_f32().data(), &[0.0, 1.0, 128.0, 255.0]);
        let color = FrameImage::Rgb8(Image::from_vec(2, 1, vec![[255, 255, 255], [10, 200, 30]]).unwrap());
        // 0.299·10 + 0.587·200 + 0.114·30 = 123.81.
        assert_eq!(color.to_gray8().data(), &[255, 124]);
        assert!((color.to_gray_f32().data()[1] - 123.81).abs() < 1e-4);
        let grey = FrameImage::Gray8(Image::filled(2, 3, 7));
        assert_eq!((grey.width(), grey.height()), (2, 3));
        assert_eq!(grey.to_rgb8(), Image::filled(2, 3, [7; 3]));
        assert_eq!((color.width(), deep.height()), (2, 1));
        assert_eq!(color.to_rgb8().data()[1], [10, 200, 30]);
    }
}
