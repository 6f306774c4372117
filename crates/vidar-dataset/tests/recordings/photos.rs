//! Folders of photographs with EXIF.

use crate::common::*;
use image::codecs::jpeg::JpegEncoder;
use proptest::prelude::*;
use vidar_core::FrameImage;
use vidar_dataset::parse::photo_exif;
use vidar_dataset::{CalibrationSource, RecordingKind};

/// A TIFF directory entry, big-endian.
fn entry(tag: u16, kind: u16, count: u32, value: [u8; 4]) -> Vec<u8> {
    [&tag.to_be_bytes()[..], &kind.to_be_bytes(), &count.to_be_bytes(), &value].concat()
}

fn short(value: u16) -> [u8; 4] {
    let [a, b] = value.to_be_bytes();
    [a, b, 0, 0]
}

/// EXIF with orientation, 35 mm equivalent, time of day and its fraction.
fn exif(orientation: u16, focal_35mm: u16, time: &str, fraction: &str) -> Vec<u8> {
    const ASCII: u16 = 2;
    const SHORT: u16 = 3;
    const LONG: u16 = 4;
    // Header 8, first directory 2 + 2·12 + 4, second 2 + 3·12 + 4, then the text.
    let (second, text_at) = (8 + 30u32, 8 + 30 + 42u32);
    let mut text = time.as_bytes().to_vec();
    text.push(0);
    let mut digits = [0u8; 4];
    digits[..fraction.len()].copy_from_slice(fraction.as_bytes());
    [
        b"MM\0\x2a\0\0\0\x08".to_vec(),
        2u16.to_be_bytes().to_vec(),
        entry(0x0112, SHORT, 1, short(orientation)),
        entry(0x8769, LONG, 1, second.to_be_bytes()),
        vec![0; 4],
        3u16.to_be_bytes().to_vec(),
        entry(0x9003, ASCII, text.len() as u32, text_at.to_be_bytes()),
        entry(0x9291, ASCII, fraction.len() as u32 + 1, digits),
        entry(0xa405, SHORT, 1, short(focal_35mm)),
        vec![0; 4],
        text,
    ]
    .concat()
}

/// A JPEG whose upper half is bright and whose lower half is dark, with EXIF.
fn photo(width: u32, height: u32, tiff: &[u8]) -> Vec<u8> {
    let pixels: Vec<u8> =
        (0..height).flat_map(|y| vec![if y < height / 2 { 220 } else { 30 }; width as usize]).collect();
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, 95)
        .encode(&pixels, width, height, image::ExtendedColorType::L8)
        .unwrap();
    let length = (2 + 6 + tiff.len()) as u16;
    [&jpeg[..2], b"\xff\xe1", &length.to_be_bytes(), b"Exif\0\0", tiff, &jpeg[2..]].concat()
}

#[test]
fn photographs_are_upright_with_the_focal_length_and_times_of_their_exif() {
    let f = Folder::new();
    for i in 0..3 {
        // Taken with the phone upright: turned clockwise by a quarter to be seen.
        let tiff = exif(6, 26, &format!("2024:03:01 12:30:0{i}"), "25");
        f.write(&format!("IMG_{i}.jpg"), photo(64, 48, &tiff));
    }
    let d = f.open().unwrap();
    assert_eq!((d.kind, d.times_are_invented), (RecordingKind::ImageFolder, false));
    assert_eq!(d.images[2].time.nanos(), 1_709_296_202_250_000_000);
    let camera = d.rig.camera(d.camera).unwrap();
    assert_eq!((camera.model.width(), camera.model.height()), (48, 64));
    // 26 mm of 43.27 mm of film, 80 px across the diagonal.
    assert!((camera.model.intrinsics().fx - 26.0 * 80.0 / 43.2666).abs() < 1e-3);
    assert_eq!(d.calibration, CalibrationSource::Guessed);
    assert!(warning(&d, "intrinsics-guessed").message.contains("26 mm"));
    warning(&d, "times-exif");
    // The upper half of the sensor's picture is the right of the upright one.
    let FrameImage::Gray8(image) = d.load_image(&d.images[0]).unwrap() else { panic!("grey") };
    assert!(image[(40, 32)] > 200 && image[(8, 32)] < 50, "{} {}", image[(40, 32)], image[(8, 32)]);
}

#[test]
fn bursts_with_equal_times_keep_their_numbers() {
    let f = Folder::new();
    for i in 0..3 {
        f.write(&format!("IMG_{i}.jpg"), photo(16, 8, &exif(1, 26, "2024:03:01 12:30:00", "0")));
    }
    let d = f.open().unwrap();
    assert!(d.times_are_invented);
    warning(&d, "times-synthesised");
    // Damaged EXIF is no EXIF.
    for i in 0..3 {
        f.write(&format!("IMG_{i}.jpg"), photo(16, 8, b"MM\0\x2a\xff\xff\xff\xff"));
    }
    let d = f.open().unwrap();
    assert!(warning(&d, "intrinsics-guessed").message.contains("is guessed"));
    assert_eq!(d.rig.cameras[0].model.width(), 16);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_exif_never_panics(at in 0usize..120, bytes in prop::collection::vec(any::<u8>(), 1..40)) {
        let mut tiff = exif(6, 26, "2024:03:01 12:30:00", "25");
        let at = at.min(tiff.len());
        let end = (at + bytes.len()).min(tiff.len());
        tiff[at..end].copy_from_slice(&bytes[..end - at]);
        let file = photo(16, 8, &tiff);
        let _ = photo_exif(&file);
        let _ = photo_exif(&file[..file.len().min(at + 30)]);
        let _ = vidar_dataset::decode::decode_image(&file, &Default::default());
    }
}
