//! Time to read an IMU csv file and to decode an image: `cargo bench -p vidar-dataset`.

use divan::counter::{BytesCount, ItemsCount};
use std::fmt::Write as _;
use std::path::Path;
use vidar_dataset::TimeUnit;
use vidar_dataset::decode::{ImageLimits, decode_image};
use vidar_dataset::parse::{self, Source, UnitRule};

fn main() {
    divan::main();
}

/// Three minutes at 200 Hz, the length of an EuRoC sequence.
const ROWS: i64 = 36_000;

fn imu_csv() -> String {
    let mut text = String::from("#timestamp [ns],w x,w y,w z,a x,a y,a z\n");
    for i in 0..ROWS {
        let s = (i as f64 * 0.01).sin();
        let _ = writeln!(
            text,
            "{},{:.16},{:.16},{:.16},{:.16},{:.16},{:.16}",
            1_403_636_580_000_000_000 + i * 5_000_000,
            0.1 * s,
            -0.2 * s,
            0.03 * s,
            9.3 + s,
            0.4 * s,
            -3.6 + s
        );
    }
    text
}

#[divan::bench]
fn euroc_imu_csv(bencher: divan::Bencher<'_, '_>) {
    let text = imu_csv();
    let source = Source { path: Path::new("imu0/data.csv"), bytes: text.as_bytes() };
    bencher.counter(BytesCount::of_str(&text)).counter(ItemsCount::new(ROWS as usize)).bench(|| {
        parse::imu_csv(divan::black_box(&source), UnitRule::Expected(TimeUnit::Nanoseconds))
            .map(|r| r.0.len())
            .ok()
    });
}

/// A grey 752×480 frame with texture and sensor noise, as EuRoC's.
fn frame(color: bool) -> image::DynamicImage {
    let mut state = 1u32;
    let mut noise = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 29) as u8
    };
    let gray =
        image::GrayImage::from_fn(752, 480, |x, y| image::Luma([((x * y / 640) % 200) as u8 + 20 + noise()]));
    let gray = image::DynamicImage::ImageLuma8(gray);
    if color { gray.to_rgb8().into() } else { gray }
}

fn encoded(color: bool, format: image::ImageFormat) -> Vec<u8> {
    let mut out = std::io::Cursor::new(Vec::new());
    let written = frame(color).write_to(&mut out, format);
    assert!(written.is_ok(), "{written:?}");
    out.into_inner()
}

#[divan::bench(args = ["png-gray", "png-rgb", "jpeg-rgb"])]
fn decode_752x480(bencher: divan::Bencher<'_, '_>, kind: &str) {
    let bytes = match kind {
        "png-gray" => encoded(false, image::ImageFormat::Png),
        "png-rgb" => encoded(true, image::ImageFormat::Png),
        _ => encoded(true, image::ImageFormat::Jpeg),
    };
    let limits = ImageLimits::default();
    bencher
        .counter(ItemsCount::new(752usize * 480))
        .bench(|| decode_image(divan::black_box(&bytes), &limits).is_ok());
}
