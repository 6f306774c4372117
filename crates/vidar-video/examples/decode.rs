//! Decodes a whole video and tells the time; with a second path, writes the frames as raw rgb24 to compare them with another decoder.
//!
//! ```sh
//! cargo run --release -p vidar-video --example decode -- clip.mp4 /tmp/frames.rgb
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
    let mut out = args.next().map(std::fs::File::create).transpose()?.map(std::io::BufWriter::new);
    let start = std::time::Instant::now();
    let video = Video::open(Path::new(&path))?;
    let mut unread = 0;
    for number in 0..video.frame_count() {
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
    let rate = video.frame_count() as f64 / secs;
    println!(
        "{} {width}x{height}: {} frames in {secs:.2} s, {rate:.1} a second, {unread} unread",
        video.codec_name(),
        video.frame_count()
    );
    Ok(())
}
