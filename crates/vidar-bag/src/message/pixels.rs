//! Pixels of uncompressed images, by the names of `sensor_msgs/image_encodings.hpp`.

use super::RawImage;
use vidar_core::{FrameImage, Image};

/// The pixels of an image.
#[derive(Clone, Debug, PartialEq)]
pub enum Pixels {
    /// Grey or colour; 16-bit grey may be depth in millimetres (`16UC1`).
    Image(FrameImage),
    /// 32-bit numbers: depth in metres (`32FC1`).
    Float(Image<f32>),
}

/// Largest width and height, pixels, as for image files.
const MAX_SIDE_PX: u32 = 16_384;

/// The pixel formats that are read, for messages.
const READ: &str = "mono8, mono16, 8UC1, 16UC1, 32FC1, rgb8, bgr8, 8UC3, rgba8, bgra8, rgb16, bgr16, rgba16, bgra16, bayer_*8, bayer_*16, yuv422, uyvy, \
                    yuv422_yuy2, yuyv, nv12, nv21, nv24";

impl RawImage {
    /// The pixels; the error is the reason as text.
    pub fn pixels(&self) -> Result<Pixels, String> {
        let (width, height) = (self.width as usize, self.height as usize);
        if self.width == 0 || self.height == 0 || self.width.max(self.height) > MAX_SIDE_PX {
            return Err(format!("its size is {width}x{height}; each side is 1 to {MAX_SIDE_PX} pixels"));
        }
        let pixel_bytes = match self.encoding.as_str() {
            "mono8" | "8UC1" => 1,
            "mono16" | "16UC1" => 2,
            "32FC1" => 4,
            "rgb8" | "bgr8" | "8UC3" => 3,
            "rgba8" | "bgra8" | "8UC4" => 4,
            "yuv422" | "uyvy" | "yuv422_yuy2" | "yuyv" => 2,
            "rgb16" | "bgr16" => 6,
            "rgba16" | "bgra16" => 8,
            // The plane of luma; chroma follows it.
            "nv12" | "nv21" | "nv24" => 1,
            name => match bayer_phase(name) {
                Some(_) if name.ends_with("16") => 2,
                Some(_) => 1,
                None => {
                    let name = vidar_core::printable(name);
                    return Err(format!("pixel format {name:?} is not read; {READ} are"));
                }
            },
        };
        let row = width * pixel_bytes;
        // Some writers leave the step at 0 where rows are not padded.
        let step = if self.row_bytes == 0 { row } else { self.row_bytes as usize };
        // Rows of less than their pixels, or a last row that is cut.
        if step < row || self.data.len() < step.saturating_mul(height - 1).saturating_add(row) {
            let found = self.data.len();
            return Err(format!(
                "{found} bytes in rows of {step} do not hold {width}x{height} pixels of {pixel_bytes} bytes"
            ));
        }
        let rows = || self.data.chunks(step).take(height).map(move |r| &r[..row]);
        let rgb = |order: [usize; 3]| {
            let pixel = move |p: &[u8]| order.map(|i| p[i]);
            let pixels = rows().flat_map(|r| r.chunks_exact(pixel_bytes).map(pixel)).collect();
            Image::from_vec(width, height, pixels).map(|i| Pixels::Image(FrameImage::Rgb8(i)))
        };
        // Of 16 bits the upper eight, where colours are made of them.
        let upper = usize::from(!self.is_big_endian);
        let made = match self.encoding.as_str() {
            "rgb16" | "rgba16" => rgb([0, 2, 4].map(|i| i + upper)),
            "bgr16" | "bgra16" => rgb([4, 2, 0].map(|i| i + upper)),
            name @ ("nv12" | "nv21" | "nv24") => {
                let chroma = self.data.get(step.saturating_mul(height)..).unwrap_or_default();
                // nv24 has chroma at every pixel, the others at every second one of every second row.
                let (share, stride) = if name == "nv24" { (1, 2 * step) } else { (2, step) };
                let (pairs, lines) = (width.div_ceil(share), height.div_ceil(share));
                if chroma.len() < stride.saturating_mul(lines - 1).saturating_add(2 * pairs)
                    || stride < 2 * pairs
                {
                    let found = self.data.len();
                    return Err(format!(
                        "{found} bytes in rows of {step} do not hold {width}x{height} pixels of {name}"
                    ));
                }
                let [u, v] = if name == "nv21" { [1, 0] } else { [0, 1] };
                let image = Image::from_fn(width, height, |x, y| {
                    let at = y / share * stride + x / share * 2;
                    rgb_of_yuv([self.data[y * step + x], chroma[at + u], chroma[at + v]])
                });
                Ok(Pixels::Image(FrameImage::Rgb8(image)))
            }
            "mono16" | "16UC1" => {
                let number = if self.is_big_endian { u16::from_be_bytes } else { u16::from_le_bytes };
                let pixels = rows().flat_map(|r| r.as_chunks::<2>().0.iter().map(|p| number(*p))).collect();
                Image::from_vec(width, height, pixels).map(|i| Pixels::Image(FrameImage::Gray16(i)))
            }
            "32FC1" => {
                let number = if self.is_big_endian { f32::from_be_bytes } else { f32::from_le_bytes };
                let pixels = rows().flat_map(|r| r.as_chunks::<4>().0.iter().map(|p| number(*p))).collect();
                Image::from_vec(width, height, pixels).map(Pixels::Float)
            }
            "rgb8" | "rgba8" => rgb([0, 1, 2]),
            // Matrices of OpenCV without a name for their colours hold blue first.
            "bgr8" | "bgra8" | "8UC3" | "8UC4" => rgb([2, 1, 0]),
            "yuv422" | "uyvy" => yuv422(width, height, rows(), [1, 0, 2]),
            "yuv422_yuy2" | "yuyv" => yuv422(width, height, rows(), [0, 1, 3]),
            name => {
                let bytes = rows()
                    .flat_map(|r| r.iter().copied().skip((pixel_bytes - 1) * upper).step_by(pixel_bytes));
                let grey = Image::from_vec(width, height, bytes.collect());
                grey.map(|grey| match bayer_phase(name) {
                    Some(phase) => Pixels::Image(FrameImage::Rgb8(demosaic(&grey, phase))),
                    None => Pixels::Image(FrameImage::Gray8(grey)),
                })
            }
        };
        made.map_err(|e| e.to_string())
    }
}

/// Column and row, modulo 2, of the red pixels.
fn bayer_phase(encoding: &str) -> Option<[usize; 2]> {
    match encoding {
        "bayer_rggb8" | "bayer_rggb16" => Some([0, 0]),
        "bayer_grbg8" | "bayer_grbg16" => Some([1, 0]),
        "bayer_gbrg8" | "bayer_gbrg16" => Some([0, 1]),
        "bayer_bggr8" | "bayer_bggr16" => Some([1, 1]),
        _ => None,
    }
}

/// Bilinear demosaicing: a missing colour is the mean of the pixels of this colour among the eight neighbours.
fn demosaic(raw: &Image<u8>, red: [usize; 2]) -> Image<[u8; 3]> {
    // 0 red, 1 green, 2 blue: red and blue sit on opposite corners of the 2×2 pattern.
    let colour = |x: usize, y: usize| ((x + red[0]) & 1) + ((y + red[1]) & 1);
    let (width, height) = (raw.width(), raw.height());
    Image::from_fn(width, height, |x, y| {
        let (mut sum, mut count) = ([0u32; 3], [0u32; 3]);
        for v in y.saturating_sub(1)..=(y + 1).min(height - 1) {
            for u in x.saturating_sub(1)..=(x + 1).min(width - 1) {
                let c = colour(u, v);
                sum[c] += u32::from(raw[(u, v)]);
                count[c] += 1;
            }
        }
        let own = colour(x, y);
        // An image of one column or row lacks colours; grey is the best guess there.
        let grey = raw[(x, y)];
        [0, 1, 2].map(|c| match count[c] {
            _ if c == own => grey,
            0 => grey,
            n => ((sum[c] + n / 2) / n) as u8,
        })
    })
}

/// Luma, U and V of BT.601, 16…235, as ROS and OpenCV take it.
fn rgb_of_yuv(yuv: [u8; 3]) -> [u8; 3] {
    let [y, u, v] = yuv.map(f32::from);
    let (luma, u, v) = (1.164_383 * (y - 16.0), u - 128.0, v - 128.0);
    let rgb = [luma + 1.596_027 * v, luma - 0.391_762 * u - 0.812_968 * v, luma + 2.017_232 * u];
    rgb.map(|c| c.round().clamp(0.0, 255.0) as u8)
}

/// Two pixels in four bytes; `at` says where the first luma, U and V lie.
fn yuv422<'a>(
    width: usize,
    height: usize,
    rows: impl Iterator<Item = &'a [u8]>,
    at: [usize; 3],
) -> Result<Pixels, vidar_core::ImageError> {
    let mut pixels = Vec::with_capacity(width * height);
    for row in rows {
        for x in 0..width {
            let pair = &row[x / 2 * 4..];
            // A row of odd width ends in half a pair, which may lack a chroma.
            let byte = |i: usize, missing: u8| pair.get(i).copied().unwrap_or(missing);
            pixels.push(rgb_of_yuv([byte(at[0] + 2 * (x % 2), 16), byte(at[1], 128), byte(at[2], 128)]));
        }
    }
    Image::from_vec(width, height, pixels).map(|i| Pixels::Image(FrameImage::Rgb8(i)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Header;

    fn image(encoding: &str, width: u32, height: u32, row_bytes: u32, data: &[u8]) -> RawImage {
        RawImage {
            header: Header::default(),
            width,
            height,
            encoding: encoding.into(),
            row_bytes,
            is_big_endian: false,
            data: data.to_vec(),
        }
    }

    fn rgb(image: &RawImage) -> Vec<[u8; 3]> {
        match image.pixels().unwrap() {
            Pixels::Image(FrameImage::Rgb8(i)) => i.into_vec(),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn padded_rows_and_swapped_colours_are_undone() {
        let padded = image("bgr8", 2, 2, 8, &[3, 2, 1, 6, 5, 4, 0, 0, 9, 8, 7, 12, 11, 10, 0, 0]);
        assert_eq!(rgb(&padded), [[1, 2, 3], [4, 5, 6], [7, 8, 9], [10, 11, 12]]);
        let with_alpha = image("rgba8", 1, 1, 0, &[1, 2, 3, 255]);
        assert_eq!(rgb(&with_alpha), [[1, 2, 3]]);
    }

    #[test]
    fn sixteen_bits_follow_the_byte_order() {
        let mut raw = image("16UC1", 2, 1, 4, &[1, 2, 3, 4]);
        assert_eq!(
            raw.pixels().unwrap(),
            Pixels::Image(FrameImage::Gray16(Image::from_vec(2, 1, vec![513, 1027]).unwrap()))
        );
        raw.is_big_endian = true;
        assert_eq!(
            raw.pixels().unwrap(),
            Pixels::Image(FrameImage::Gray16(Image::from_vec(2, 1, vec![258, 772]).unwrap()))
        );
        let metres = image("32FC1", 1, 1, 4, &1.5f32.to_le_bytes());
        assert_eq!(metres.pixels().unwrap(), Pixels::Float(Image::from_vec(1, 1, vec![1.5]).unwrap()));
    }

    #[test]
    fn a_uniform_colour_survives_every_bayer_pattern() {
        for (name, pattern) in [
            ("bayer_rggb8", [0, 1, 1, 2]),
            ("bayer_grbg8", [1, 0, 2, 1]),
            ("bayer_gbrg8", [1, 2, 0, 1]),
            ("bayer_bggr8", [2, 1, 1, 0]),
        ] {
            let colours = [200u8, 120, 40];
            let data: Vec<u8> = (0..6 * 4).map(|i| colours[pattern[(i / 6 % 2) * 2 + i % 6 % 2]]).collect();
            assert!(rgb(&image(name, 6, 4, 6, &data)).iter().all(|p| *p == colours), "{name}");
            // The same in the upper bytes of 16 bits, in both byte orders.
            let wide: Vec<u8> = data.iter().flat_map(|v| [7, *v]).collect();
            let mut raw = image(&name.replace('8', "16"), 6, 4, 12, &wide);
            assert!(rgb(&raw).iter().all(|p| *p == colours), "{name} of 16 bits");
            (raw.is_big_endian, raw.data) = (true, data.iter().flat_map(|v| [*v, 7]).collect());
            assert!(rgb(&raw).iter().all(|p| *p == colours), "{name} of 16 bits, big-endian");
        }
    }

    #[test]
    fn colours_of_sixteen_bits_keep_their_upper_bytes() {
        let data = [0, 10, 0, 20, 0, 30, 9, 40, 9, 50, 9, 60];
        assert_eq!(rgb(&image("rgb16", 2, 1, 12, &data)), [[10, 20, 30], [40, 50, 60]]);
        assert_eq!(rgb(&image("bgr16", 2, 1, 12, &data)), [[30, 20, 10], [60, 50, 40]]);
        assert_eq!(rgb(&image("bgra16", 1, 1, 8, &data[..8])), [[30, 20, 10]]);
    }

    #[test]
    fn planes_of_chroma_belong_to_their_pixels() {
        // 4×2 pixels: red on the left, white on the right; rows are padded to six bytes.
        let luma = [81, 81, 235, 235, 0, 0, 81, 81, 235, 235, 0, 0];
        let with = |chroma: &[u8]| [&luma[..], chroma].concat();
        for (name, chroma) in [
            ("nv12", vec![90, 240, 128, 128]),
            ("nv21", vec![240, 90, 128, 128]),
            ("nv24", [[90, 240, 90, 240, 128, 128, 128, 128, 0, 0, 0, 0]; 2].concat()),
        ] {
            let found = rgb(&image(name, 4, 2, 6, &with(&chroma)));
            for (at, pixel) in found.iter().enumerate() {
                let expected = if at % 4 < 2 { [255, 0, 0] } else { [255; 3] };
                assert!((0..3).all(|c| pixel[c].abs_diff(expected[c]) <= 2), "{name}: {found:?}");
            }
            let short = with(&chroma[..2]);
            assert!(image(name, 4, 2, 6, &short).pixels().unwrap_err().contains(name));
        }
    }

    #[test]
    fn yuv_of_known_colours_becomes_them() {
        // BT.601 red: Y 81, U 90, V 240; white: Y 235, U V 128.
        let red = rgb(&image("uyvy", 2, 1, 4, &[90, 81, 240, 81]))[1];
        assert!(red[0] >= 253 && red[1] <= 2 && red[2] <= 2, "{red:?}");
        assert_eq!(rgb(&image("yuyv", 2, 1, 4, &[235, 128, 235, 128])), [[255; 3]; 2]);
    }

    #[test]
    fn sizes_that_the_bytes_do_not_hold_are_refused() {
        for (bad, says) in [
            (image("mono8", 4, 4, 4, &[0; 15]), "15 bytes in rows of 4"),
            (image("mono8", 4, 4, 3, &[0; 16]), "rows of 3"),
            (image("mono8", 0, 4, 4, &[0; 16]), "0x4"),
            (image("mono8", u32::MAX, u32::MAX, u32::MAX, &[0; 16]), "each side"),
            (image("nv99", 4, 4, 4, &[0; 16]), "nv99"),
        ] {
            let reason = bad.pixels().unwrap_err();
            assert!(reason.contains(says), "{reason}");
        }
    }
}
