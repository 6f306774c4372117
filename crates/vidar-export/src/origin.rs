//! Where depth comes from, as two 8-bit grey PNG images beside a depth image.
//!
//! The one holds the numbers of [`DepthSource`] (0 none, 1 stereo, 2 map, 3 plane, 4 network, 5 interpolation), the other the
//! standard deviation of ln(depth) in steps of [`STD_STEP`]; 255 stands for everything above, 0 for no depth.

use crate::error::{ExportError, write_error};
use std::io::{self, Write};
use vidar_core::{DepthOrigin, Image};

const FORMAT: &str = "depth origin PNG";

/// One step of the standard deviation of ln(depth): 0.2 %.
pub const STD_STEP: f32 = 0.002;

/// Writes the source of each pixel.
pub fn write_source_png(w: impl Write, origins: &Image<DepthOrigin>) -> Result<(), ExportError> {
    write_gray8(w, origins, |o| o.source as u8)
}

/// Writes the standard deviation of ln(depth) of each pixel.
pub fn write_std_png(w: impl Write, origins: &Image<DepthOrigin>) -> Result<(), ExportError> {
    // `as` saturates, and takes NaN to 0; what has a depth has at least one step.
    let steps = |o: &DepthOrigin| match o.log_std.is_nan() {
        true => 0,
        false => ((o.log_std / STD_STEP).round() as u8).max(1),
    };
    write_gray8(w, origins, steps)
}

fn write_gray8(
    mut w: impl Write,
    origins: &Image<DepthOrigin>,
    value: impl Fn(&DepthOrigin) -> u8,
) -> Result<(), ExportError> {
    let (Ok(width), Ok(height)) = (u32::try_from(origins.width()), u32::try_from(origins.height())) else {
        return Err(ExportError::unwritable(FORMAT, "the image", "a side exceeds 32 bits"));
    };
    if width == 0 || height == 0 {
        return Err(ExportError::unwritable(FORMAT, "the image", "it has no pixels"));
    }
    let data: Vec<u8> = origins.data().iter().map(value).collect();
    let encode = |w: &mut dyn Write| -> Result<(), png::EncodingError> {
        let mut encoder = png::Encoder::new(w, width, height);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Eight);
        // As depth images: a thirtieth of the time, files of nearly the same size.
        encoder.set_compression(png::Compression::Fast);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&data)?;
        writer.finish()
    };
    let written = encode(&mut w).map_err(|error| match error {
        png::EncodingError::IoError(source) => source,
        other => io::Error::other(other),
    });
    written.and_then(|()| w.flush()).map_err(write_error(FORMAT))
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::DepthSource;

    fn read(bytes: &[u8]) -> Vec<u8> {
        let mut reader = png::Decoder::new(io::Cursor::new(bytes)).read_info().unwrap();
        let mut data = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut data).unwrap();
        data
    }

    #[test]
    fn sources_are_their_numbers_and_deviations_steps() {
        let of = |source, log_std| DepthOrigin { source, log_std };
        let origins = vec![
            DepthOrigin::NONE,
            of(DepthSource::Stereo, 0.0201),
            of(DepthSource::Plane, 1e-6),
            of(DepthSource::Interpolation, 3.0),
        ];
        let origins = Image::from_vec(2, 2, origins).unwrap();
        let (mut source, mut std) = (Vec::new(), Vec::new());
        write_source_png(&mut source, &origins).unwrap();
        write_std_png(&mut std, &origins).unwrap();
        assert_eq!(read(&source), [0, 1, 3, 5]);
        assert_eq!(read(&std), [0, 10, 1, 255]);
        assert!(write_std_png(&mut std, &Image::filled(0, 0, DepthOrigin::NONE)).is_err());
    }
}
