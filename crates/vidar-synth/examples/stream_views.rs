//! Writes clips of overlapping views of many rooms to standard output, endlessly or counted.
//!
//! ```text
//! stream_views [--split train|val|test] [--first-room R] [--rooms N] [--clips C] [--views V]
//!              [--sizes 112x70:3,98x84:1] [--samples S] [--home-share SHARE]
//! ```
//!
//! Rooms `R`, `R + 1`, … of the split (`--rooms 0`: without end) give `C` clips each of `V` views; a clip's size is
//! drawn by weight. `--home-share` makes that share of the rooms homes, looked over from near by. The stream is the
//! same for the same arguments. All numbers are little-endian:
//!
//! | bytes | what |
//! |---|---|
//! | 8 | `VIDARCL1` |
//! | 8 + 4 + 4 | room seed (u64), clip number, number of views V (u32) |
//! | 4 + 4 | width W, height H (u32) |
//! | 16 | fx, fy, cx, cy (f32, pixels; centre of the first pixel is 0, 0) |
//! | V × 48 | `world_from_camera`, upper 3 × 4 by rows (f32, m; x right, y down, z forward) |
//! | V × H·W·3 | red, green, blue (u8) |
//! | V × H·W·4 | z-depth (f32, m; 0 where there is none) |
//!
//! The next clip follows at once. A closed pipe ends the program quietly.

use std::error::Error;
use std::io::{BufWriter, ErrorKind, Write};
use vidar_synth::clip::{Clip, ClipRoom, ClipSettings, Split};

const MAGIC: &[u8; 8] = b"VIDARCL1";

struct Arguments {
    split: Split,
    first_room: u32,
    rooms: u32,
    clips: u32,
    views: usize,
    samples: usize,
    sizes: Vec<([usize; 2], u64)>,
    home_share: f64,
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments = arguments()?;
    let mut out = BufWriter::with_capacity(1 << 20, std::io::stdout().lock());
    match stream(&arguments, &mut out) {
        Err(e) if e.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == ErrorKind::BrokenPipe) => {
            Ok(())
        }
        other => other,
    }
}

fn stream(arguments: &Arguments, out: &mut impl Write) -> Result<(), Box<dyn Error>> {
    let widest = arguments.sizes.iter().map(|(size, _)| size[0].max(size[1])).max().unwrap_or(112);
    let last =
        if arguments.rooms == 0 { u32::MAX } else { arguments.first_room.saturating_add(arguments.rooms) };
    for index in arguments.first_room..last {
        let room = ClipRoom::with_homes(arguments.split, index, widest, arguments.home_share)?;
        for number in 0..arguments.clips {
            let [width, height] = size_of(&arguments.sizes, room.seed(), number);
            let settings = ClipSettings { views: arguments.views, width, height, samples: arguments.samples };
            write_clip(room.seed(), number, &room.clip(number, &settings)?, out)?;
        }
        out.flush()?;
    }
    Ok(())
}

/// The size of a clip, drawn by weight.
fn size_of(sizes: &[([usize; 2], u64)], seed: u64, number: u32) -> [usize; 2] {
    let total: u64 = sizes.iter().map(|(_, weight)| weight).sum();
    let drawn = (seed ^ u64::from(number).rotate_left(32)).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 33;
    let mut left = drawn % total.max(1);
    for (size, weight) in sizes {
        if left < *weight {
            return *size;
        }
        left -= weight;
    }
    sizes[0].0
}

fn write_clip(seed: u64, number: u32, clip: &Clip, out: &mut impl Write) -> std::io::Result<()> {
    out.write_all(MAGIC)?;
    out.write_all(&seed.to_le_bytes())?;
    let camera = &clip.camera;
    for value in [number, clip.views.len() as u32, camera.width as u32, camera.height as u32] {
        out.write_all(&value.to_le_bytes())?;
    }
    for value in [camera.fx, camera.fy, camera.cx, camera.cy] {
        out.write_all(&(value as f32).to_le_bytes())?;
    }
    for view in &clip.views {
        let matrix = view.world_from_camera.matrix();
        for row in 0..3 {
            for column in 0..4 {
                out.write_all(&(matrix[(row, column)] as f32).to_le_bytes())?;
            }
        }
    }
    for view in &clip.views {
        out.write_all(view.image.data().as_flattened())?;
    }
    for view in &clip.views {
        for depth in view.depth.data() {
            let known = if depth.is_finite() { *depth } else { 0.0 };
            out.write_all(&known.to_le_bytes())?;
        }
    }
    Ok(())
}

fn arguments() -> Result<Arguments, Box<dyn Error>> {
    let mut found = Arguments {
        split: Split::Train,
        first_room: 0,
        rooms: 0,
        clips: 8,
        views: 8,
        samples: 3,
        sizes: vec![([112, 70], 1)],
        home_share: 0.0,
    };
    let mut rest = std::env::args().skip(1);
    while let Some(key) = rest.next() {
        let value = rest.next().ok_or_else(|| format!("{key} needs a value"))?;
        match key.as_str() {
            "--split" => {
                found.split = match value.as_str() {
                    "train" => Split::Train,
                    "val" => Split::Validation,
                    "test" => Split::Test,
                    other => return Err(format!("--split is train, val or test, not {other}").into()),
                }
            }
            "--first-room" => found.first_room = value.parse()?,
            "--rooms" => found.rooms = value.parse()?,
            "--clips" => found.clips = value.parse()?,
            "--views" => found.views = value.parse()?,
            "--home-share" => found.home_share = value.parse()?,
            "--samples" => found.samples = value.parse()?,
            "--sizes" => found.sizes = value.split(',').map(size).collect::<Result<_, _>>()?,
            other => return Err(format!("unknown argument {other}; see the program's head").into()),
        }
    }
    Ok(found)
}

/// `112x70:3`, or `112x70` for a weight of 1.
fn size(text: &str) -> Result<([usize; 2], u64), Box<dyn Error>> {
    let (size, weight) = text.split_once(':').unwrap_or((text, "1"));
    let (width, height) = size.split_once('x').ok_or_else(|| format!("a size is WxH:weight, not {text}"))?;
    Ok(([width.parse()?, height.parse()?], weight.parse()?))
}
