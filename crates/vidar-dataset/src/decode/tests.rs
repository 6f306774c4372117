use super::*;

fn encode(
    color: png::ColorType,
    depth: png::BitDepth,
    extra: &[(png::chunk::ChunkType, &[u8])],
    data: &[u8],
) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, 4, 2);
    encoder.set_color(color);
    encoder.set_depth(depth);
    if color == png::ColorType::Indexed {
        encoder.set_palette(vec![10, 20, 30, 200, 100, 50]);
    }
    let mut writer = encoder.write_header().unwrap();
    for (kind, bytes) in extra {
        writer.write_chunk(*kind, bytes).unwrap();
    }
    writer.write_image_data(data).unwrap();
    drop(writer);
    out
}

fn decode(bytes: &[u8]) -> Result<FrameImage, String> {
    decode_image(bytes, &ImageLimits::default())
}

#[test]
fn every_kind_of_png_becomes_grey_or_colour() {
    use png::{BitDepth, ColorType};
    let gray8 =
        decode(&encode(ColorType::Grayscale, BitDepth::Eight, &[], &[0, 1, 2, 3, 4, 5, 6, 255])).unwrap();
    assert!(matches!(&gray8, FrameImage::Gray8(i) if i.data() == [0, 1, 2, 3, 4, 5, 6, 255]));

    let bits =
        decode(&encode(ColorType::Grayscale, BitDepth::One, &[], &[0b1010_0000, 0b0001_0000])).unwrap();
    assert!(matches!(&bits, FrameImage::Gray8(i) if i.data() == [255, 0, 255, 0, 0, 0, 0, 255]), "{bits:?}");

    let deep: Vec<u8> = (0..8u16).flat_map(|v| (v * 9000).to_be_bytes()).collect();
    let gray16 = decode(&encode(ColorType::Grayscale, BitDepth::Sixteen, &[], &deep)).unwrap();
    assert!(matches!(&gray16, FrameImage::Gray16(i) if i[(3, 1)] == 63_000));

    let alpha = decode(&encode(ColorType::GrayscaleAlpha, BitDepth::Eight, &[], &[7; 16])).unwrap();
    assert!(matches!(&alpha, FrameImage::Gray8(i) if i.data() == [7; 8]));

    let rgba: Vec<u8> = (0..8u8).flat_map(|v| [v, 2 * v, 3 * v, 0]).collect();
    let colour = decode(&encode(ColorType::Rgba, BitDepth::Eight, &[], &rgba)).unwrap();
    assert!(
        matches!(&colour, FrameImage::Rgb8(i) if i[(2, 1)] == [6, 12, 18]),
        "transparent pixels keep their colour"
    );

    let palette = decode(&encode(ColorType::Indexed, BitDepth::One, &[], &[0b0100_0000, 0])).unwrap();
    assert!(
        matches!(&palette, FrameImage::Rgb8(i) if i[(1, 0)] == [200, 100, 50] && i[(0, 0)] == [10, 20, 30])
    );

    let deep: Vec<u8> = (0..24u16).flat_map(|v| (v * 257).to_be_bytes()).collect();
    let rgb16 = decode(&encode(ColorType::Rgb, BitDepth::Sixteen, &[], &deep)).unwrap();
    assert!(matches!(&rgb16, FrameImage::Rgb8(i) if i[(1, 1)] == [15, 16, 17]));
}

/// A JPEG of 16×16 pixels by the encoder that comes with the decoder.
fn jpeg(color: bool) -> Vec<u8> {
    let mut out = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, 95);
    if color {
        image::RgbImage::from_fn(16, 16, |x, _| image::Rgb([200, 10 * x as u8, 30]))
            .write_with_encoder(encoder)
            .unwrap();
    } else {
        image::GrayImage::from_fn(16, 16, |x, _| image::Luma([10 * x as u8]))
            .write_with_encoder(encoder)
            .unwrap();
    }
    out
}

#[test]
fn jpegs_are_grey_or_colour_and_every_truncation_is_detected() {
    assert!(matches!(decode(&jpeg(false)).unwrap(), FrameImage::Gray8(_)));
    let whole = jpeg(true);
    let colour = decode(&whole).unwrap();
    assert!(matches!(&colour, FrameImage::Rgb8(i) if i[(8, 8)][0] > 180));
    for keep in 0..whole.len() - 1 {
        assert!(decode(&whole[..keep]).is_err(), "{keep} of {} bytes decode", whole.len());
    }
    let padded = [whole.clone(), vec![0; 100]].concat();
    assert_eq!(decode(&padded).unwrap(), colour);
}

#[test]
fn truncated_pngs_are_refused_wherever_pixels_are_missing() {
    let whole = encode(png::ColorType::Grayscale, png::BitDepth::Eight, &[], &[9; 8]);
    // The end chunk has 12 bytes and carries no pixels; the 4 before it are the checksum of the data.
    for keep in 0..whole.len() - 16 {
        assert!(decode(&whole[..keep]).is_err(), "{keep} of {} bytes decode", whole.len());
    }
}

/// A PNG header that says `width`×`height`, with a checksum that holds, and four bytes of pixels after it.
fn header(width: u32, height: u32) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, width, height);
    encoder.set_color(png::ColorType::Grayscale);
    let mut writer = encoder.write_header().unwrap();
    writer.write_chunk(png::chunk::IDAT, &[0; 4]).unwrap();
    drop(writer);
    out
}

#[test]
fn headers_with_too_large_sizes_are_refused_before_allocation() {
    let error = decode(&header(20_000, 4)).unwrap_err();
    assert!(error.contains("20000x4") || error.contains("limit"), "{error}");
    let error = decode(&header(16_384, 16_384)).unwrap_err();
    assert!(error.contains("more than") && error.contains("bytes can hold"), "{error}");
    let small = ImageLimits { max_decoded_bytes: 7, ..Default::default() };
    let whole = encode(png::ColorType::Grayscale, png::BitDepth::Eight, &[], &[9; 8]);
    assert!(
        decode_image(&whole, &small).unwrap_err().contains("8 bytes; the limit is 7"),
        "a limit below the image"
    );
}

#[test]
fn empty_files_and_other_formats_are_named() {
    assert!(decode(&[]).unwrap_err().contains("0 bytes"));
    assert!(decode(b"GIF89a").unwrap_err().contains("neither PNG nor JPEG"));
    assert!(decode(&[0xff]).unwrap_err().contains("neither"));
}

#[test]
fn palettes_that_make_the_decoder_panic_are_refused() {
    use png::chunk;
    let four_bytes = encode(png::ColorType::Indexed, png::BitDepth::Eight, &[], &[0; 8]);
    // The palette's length field follows the header chunk: 8 signature + 25 header bytes.
    let mut cut = four_bytes.clone();
    assert_eq!(&cut[37..41], b"PLTE");
    cut[36] = 4;
    assert!(decode(&cut).unwrap_err().contains("a palette of 4 bytes"));
    let transparent =
        encode(png::ColorType::Indexed, png::BitDepth::Eight, &[(chunk::tRNS, &[0; 3])], &[0; 8]);
    assert!(decode(&transparent).unwrap_err().contains("3 transparencies for 2 colours"));
    let fitting = encode(png::ColorType::Indexed, png::BitDepth::Eight, &[(chunk::tRNS, &[0; 2])], &[0; 8]);
    assert!(decode(&fitting).is_ok());
}

#[test]
fn depth_must_be_grey() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("d.png");
    std::fs::write(&path, encode(png::ColorType::Rgb, png::BitDepth::Eight, &[], &[9; 24])).unwrap();
    assert!(read_depth(&path).unwrap_err().to_string().contains("16-bit grey"));
    std::fs::write(&path, encode(png::ColorType::Grayscale, png::BitDepth::Eight, &[], &[9; 8])).unwrap();
    assert_eq!(read_depth(&path).unwrap()[(3, 1)], 9);
    assert_eq!(read_size(&path).unwrap(), (4, 2));
}
