//! Decodes a video and tells the time; with a second path, writes the frames as raw rgb24 to compare them with another decoder. A third
//! number takes every n-th frame (`-` instead of a path writes nothing).
//!
//! ```sh
//! cargo run --release -p vidar-video --example decode -- clip.mp4 /tmp/frames.rgb
//! time target/release/examples/decode clip.mp4 - 5
//! ffmpeg -i clip.mp4 -fps_mode passthrough -f rawvideo -pix_fmt rgb24 /tmp/reference.rgb
//! ```

#![allow(clippy::print_stdout, reason = "the example's output")]

use std::io::Write;
use std::path::Path;
use vidar_core::FrameImage;
use vidar_video::Video;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args_os().skip(1);
    let path = args.next().ok_or("give a video")?;
    let out = args.next().filter(|path| path != "-").map(std::fs::File::create).transpose()?;
    let mut out = out.map(std::io::BufWriter::new);
    let every = args.next().map_or(Ok(1), |n| n.to_string_lossy().parse::<usize>())?.max(1);
    let start = std::time::Instant::now();
    let video = Video::open(Path::new(&path))?;
    let frames = || (0..video.frame_count()).step_by(every);
    video.expect(frames());
    let mut unread = 0;
    for number in frames() {
        match (video.frame(number), &mut out) {
            (Ok(FrameImage::Rgb8(image)), Some(out)) => out.write_all(image.data().as_flattened())?,
            (Ok(_), _) => {}
            (Err(e), _) => {
                unread += 1;
                println!("{e}");
            }
        }
    }
    let secs = start.elapsed().as_secs_f64();
    let (width, height) = video.size();
    let (count, rate) = (frames().count(), video.frame_count() as f64 / secs);
    println!(
        "{} {width}x{height}: {count} of {} frames in {secs:.2} s, {rate:.1} of the video's frames a second, {unread} unread",
        video.codec_name(),
        video.frame_count()
    );
    Ok(())
}
