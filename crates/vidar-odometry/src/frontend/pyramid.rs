//! Image pyramids: every level halves the one below by the mean of 2×2 pixels, rounded to nearest.
//!
//! A pixel of level *l* covers 2^l × 2^l pixels of level 0, so its centre lies at `(x + ½)·2^l − ½`: coordinates of two
//! levels differ by more than a factor, and [`to_level`]/[`from_level`] are the only conversions.

use super::error::FrontendError;
use vidar_core::camera::Pixel;
use vidar_core::simd::kernel;
use vidar_core::{FrameImage, Image};

/// Levels of the odometry's pyramids, each half the size of the one before: 752 × 480 pixels become 47 × 30.
pub const PYRAMID_LEVELS: usize = 5;

/// Smallest side of a level that is still built, pixels: a patch and its search must fit.
const MIN_SIDE_PX: usize = 24;

/// Grey levels of one image at several resolutions. Buffers are kept when it is rebuilt.
#[derive(Clone, Debug)]
pub struct Pyramid {
    levels: Vec<Image<u8>>,
}

impl Pyramid {
    /// Buffers for images of `width` × `height` with up to `levels` levels (fewer when they would be tiny).
    pub fn new(width: usize, height: usize, levels: usize) -> Self {
        let mut all = vec![Image::filled(width, height, 0_u8)];
        let (mut w, mut h) = (width / 2, height / 2);
        while all.len() < levels && w.min(h) >= MIN_SIDE_PX {
            all.push(Image::filled(w, h, 0_u8));
            (w, h) = (w / 2, h / 2);
        }
        Self { levels: all }
    }

    /// The pyramid of `image`, in new buffers.
    pub fn of(image: &Image<u8>, levels: usize) -> Self {
        let mut pyramid = Self::new(image.width(), image.height(), levels);
        pyramid.levels[0].data_mut().copy_from_slice(image.data());
        pyramid.halve();
        pyramid
    }

    /// Takes `image` (8-bit, 16-bit or colour; grey levels as [`FrameImage::to_gray8`]) without allocating.
    ///
    /// # Errors
    /// The image has another size than the buffers.
    pub fn rebuild(&mut self, image: &FrameImage) -> Result<(), FrontendError> {
        let base = &mut self.levels[0];
        if (image.width(), image.height()) != (base.width(), base.height()) {
            return Err(FrontendError::SizeMismatch {
                width: base.width(),
                height: base.height(),
                found_width: image.width(),
                found_height: image.height(),
            });
        }
        let out = base.data_mut();
        match image {
            FrameImage::Gray8(i) => out.copy_from_slice(i.data()),
            FrameImage::Gray16(i) => {
                out.iter_mut().zip(i.data()).for_each(|(o, &p)| *o = ((u32::from(p) + 128) / 257) as u8);
            }
            FrameImage::Rgb8(i) => out.iter_mut().zip(i.data()).for_each(|(o, p)| *o = luma(p)),
        }
        self.halve();
        Ok(())
    }

    /// Level of images of `width` × `height` that is at most `max_width` wide, or the coarsest that is built.
    pub(crate) fn level_for(width: usize, height: usize, max_width: usize) -> usize {
        let is_built = |level: usize| (width >> level).min(height >> level) >= MIN_SIDE_PX;
        (0..).find(|&level| width >> level <= max_width || !is_built(level + 1)).unwrap_or(0)
    }

    /// Number of levels.
    pub fn level_count(&self) -> usize {
        self.levels.len()
    }

    /// Level `l`; 0 is the image itself.
    pub fn level(&self, l: usize) -> &Image<u8> {
        &self.levels[l]
    }

    /// Columns of level 0.
    pub fn width(&self) -> usize {
        self.levels[0].width()
    }

    /// Rows of level 0.
    pub fn height(&self) -> usize {
        self.levels[0].height()
    }

    fn halve(&mut self) {
        for l in 1..self.levels.len() {
            let (below, above) = self.levels.split_at_mut(l);
            let (from, to) = (&below[l - 1], &mut above[0]);
            half_sample(from, to);
        }
    }
}

/// BT.601 luma, rounded, as [`FrameImage::to_gray8`] has it.
fn luma(p: &[u8; 3]) -> u8 {
    (0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2])).round() as u8
}

kernel! {
    fn half_sample(from: &Image<u8>, to: &mut Image<u8>) {
        average_blocks(from, to);
    }
}

/// `(a + b + c + d + 2) / 4` of every 2×2 block; an odd last row or column is left out.
#[inline(always)]
fn average_blocks(from: &Image<u8>, to: &mut Image<u8>) {
    let (width, height) = (to.width(), to.height());
    let stride = from.width();
    for y in 0..height {
        let top = &from.data()[2 * y * stride..][..2 * width];
        let bottom = &from.data()[(2 * y + 1) * stride..][..2 * width];
        let out = &mut to.data_mut()[y * width..(y + 1) * width];
        let pairs = top.chunks_exact(2).zip(bottom.chunks_exact(2));
        for (o, (a, b)) in out.iter_mut().zip(pairs) {
            let sum = u16::from(a[0]) + u16::from(a[1]) + u16::from(b[0]) + u16::from(b[1]);
            *o = ((sum + 2) >> 2) as u8;
        }
    }
}

/// Pixels of level 0 per pixel of level `l`.
pub fn level_scale(l: usize) -> f64 {
    (1_u32 << l) as f64
}

/// Where a pixel of level 0 lies on level `l`.
pub fn to_level(pixel: &Pixel, l: usize) -> Pixel {
    pixel.map(|c| (c + 0.5) / level_scale(l) - 0.5)
}

/// Where a pixel of level `l` lies on level 0.
pub fn from_level(pixel: &Pixel, l: usize) -> Pixel {
    pixel.map(|c| (c + 0.5) * level_scale(l) - 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::testing::same_with_each_instruction_set;

    #[test]
    fn levels_are_rounded_means_of_blocks() {
        let image = Image::from_fn(97, 50, |x, y| ((x * 7 + y * 13) % 256) as u8);
        let pyramid = Pyramid::of(&image, 5);
        assert_eq!(pyramid.level_count(), 2, "a level of 24x12 would be too small");
        assert_eq!((pyramid.level(1).width(), pyramid.level(1).height()), (48, 25));
        for y in 0..25 {
            for x in 0..48 {
                let at = |dx, dy| u32::from(image[(2 * x + dx, 2 * y + dy)]);
                let mean = (at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1) + 2) / 4;
                assert_eq!(u32::from(pyramid.level(1)[(x, y)]), mean);
            }
        }
    }

    #[test]
    fn the_bits_do_not_depend_on_the_instructions() {
        let image = Image::from_fn(301, 203, |x, y| ((x * x + 31 * y + x * y) % 256) as u8);
        let levels = same_with_each_instruction_set(|| {
            let pyramid = Pyramid::of(&image, 4);
            (0..pyramid.level_count()).map(|l| pyramid.level(l).clone()).collect::<Vec<_>>()
        });
        assert_eq!(levels.len(), 4);
    }

    #[test]
    fn every_kind_of_image_is_taken_and_other_sizes_are_refused() {
        let deep = Image::from_fn(64, 48, |x, y| (x * 900 + y * 100) as u16);
        let color = Image::from_fn(64, 48, |x, y| [x as u8, y as u8, 200]);
        let mut pyramid = Pyramid::new(64, 48, 3);
        for image in [FrameImage::Gray16(deep), FrameImage::Rgb8(color)] {
            pyramid.rebuild(&image).unwrap();
            assert_eq!(*pyramid.level(0), image.to_gray8());
        }
        let error = pyramid.rebuild(&FrameImage::Gray8(Image::filled(63, 48, 0))).unwrap_err();
        assert_eq!(error.to_string(), "image is 63x48, the front end was made for 64x48");
    }

    #[test]
    fn level_coordinates_put_block_centres_on_pixel_centres() {
        let block = Pixel::new(2.5, 4.5);
        assert_eq!(to_level(&block, 1), Pixel::new(1.0, 2.0));
        assert_eq!(from_level(&Pixel::new(1.0, 2.0), 1), block);
        assert_eq!(from_level(&to_level(&Pixel::new(0.25, -7.0), 3), 3), Pixel::new(0.25, -7.0));
    }
}
