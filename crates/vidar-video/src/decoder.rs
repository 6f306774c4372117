//! Decoders on a thread of their own: a panic or a hang inside one becomes an error of one frame.

use crate::picture::{Colours, Picture, check_size, colours_of, round_to_eight};
use rust_h264::nal::{parse_avcc, parse_avcc_config, parse_sps_info};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

/// The codec of a track with its parameter sets.
#[derive(Clone, Debug)]
pub(crate) enum Codec {
    /// The `avcC` box.
    H264(Vec<u8>),
    /// The `hvcC` box.
    #[cfg(feature = "h265")]
    H265(Vec<u8>),
}

/// A sample to decode.
struct Job {
    sample: usize,
    bytes: Vec<u8>,
    /// Whether no sample follows.
    is_last: bool,
}

/// Pictures that came out, with the samples they belong to; the text is why the sample gave none.
type Reply = Result<Vec<(usize, Picture)>, String>;

/// A running decoder.
pub(crate) struct Decoder {
    jobs: SyncSender<Job>,
    replies: Receiver<Reply>,
}

/// Longest time for one picture. A picture of 1080p takes 0.04 s; one of 8K on a machine ten times slower stays below this, and a
/// decoder that needs longer hangs.
const PICTURE_LIMIT: Duration = Duration::from_secs(20);

/// Name of the thread, by which a program can tell its panics from others.
pub const DECODER_THREAD: &str = "vidar video decoder";

impl Decoder {
    /// Starts a decoder for a codec.
    pub(crate) fn start(codec: &Codec) -> Result<Self, String> {
        let (jobs, work) = sync_channel::<Job>(1);
        let (done, replies) = sync_channel::<Reply>(1);
        let codec = codec.clone();
        // The thread ends when the channels close: with this value, or by its own panic.
        let thread = std::thread::Builder::new().name(DECODER_THREAD.into());
        let spawned = thread.spawn(move || {
            let mut machine = match Machine::new(&codec) {
                Ok(machine) => machine,
                Err(reason) => return drop(done.send(Err(reason))),
            };
            while let Ok(job) = work.recv() {
                if done.send(machine.decode(&job)).is_err() {
                    return;
                }
            }
        });
        spawned.map_err(|e| format!("no thread for the decoder: {e}"))?;
        Ok(Self { jobs, replies })
    }

    /// Decodes the next sample. After `Err(true, …)` the decoder is gone.
    pub(crate) fn decode(
        &self,
        sample: usize,
        bytes: Vec<u8>,
        is_last: bool,
    ) -> Result<Vec<(usize, Picture)>, Failure> {
        // A decoder that refused its parameter sets has said so already.
        let sent = self.jobs.send(Job { sample, bytes, is_last });
        match self.replies.recv_timeout(PICTURE_LIMIT) {
            Ok(Ok(pictures)) => Ok(pictures),
            Ok(Err(reason)) => Err(Failure { reason, is_fatal: sent.is_err() }),
            Err(RecvTimeoutError::Timeout) => {
                let reason = format!("the decoder did not finish within {} s", PICTURE_LIMIT.as_secs());
                Err(Failure { reason, is_fatal: true })
            }
            Err(RecvTimeoutError::Disconnected) => {
                let reason =
                    "the decoder broke down on this frame (the video is damaged, or the decoder has a fault)";
                Err(Failure { reason: reason.into(), is_fatal: true })
            }
        }
    }
}

/// Why a sample gave no picture.
pub(crate) struct Failure {
    pub reason: String,
    /// Whether the decoder must be started anew.
    pub is_fatal: bool,
}

/// What runs on the thread.
enum Machine {
    H264 {
        decoder: Box<rust_h264::decoder::Decoder>,
        length_size: usize,
        colours: Colours,
    },
    #[cfg(feature = "h265")]
    H265(Box<crate::h265::H265>),
}

impl Machine {
    fn new(codec: &Codec) -> Result<Self, String> {
        match codec {
            Codec::H264(avcc) => {
                let config = parse_avcc_config(avcc).map_err(str::to_string)?;
                let mut decoder = Box::new(rust_h264::decoder::Decoder::new());
                let mut colours = Colours { is_full_range: false, is_bt709: false };
                for nal in &config.sps_nals {
                    let info = parse_sps_info(nal).map_err(|e| format!("sequence parameters: {e}"))?;
                    check_size(u64::from(info.coded_width), u64::from(info.coded_height))?;
                    colours = colours_of(info.full_range, info.matrix, info.height as usize);
                }
                for nal in config.sps_nals.iter().chain(&config.pps_nals) {
                    decoder.decode_nal(nal).map_err(|e| format!("parameter sets: {e}"))?;
                }
                Ok(Self::H264 { decoder, length_size: config.length_size, colours })
            }
            #[cfg(feature = "h265")]
            Codec::H265(hvcc) => crate::h265::H265::new(hvcc).map(Box::new).map(Self::H265),
        }
    }

    fn decode(&mut self, job: &Job) -> Reply {
        match self {
            Self::H264 { decoder, length_size, colours } => {
                let mut first_error = None;
                for nal in parse_avcc(&job.bytes, *length_size) {
                    if nal.nal_unit_type == rust_h264::nal::NalUnitType::Sps
                        && let Ok(info) = parse_sps_info(&nal)
                    {
                        check_size(u64::from(info.coded_width), u64::from(info.coded_height))?;
                    }
                    if let Err(e) = decoder.decode_nal(&nal) {
                        first_error.get_or_insert(e.to_string());
                    }
                }
                // A sample of the container is one picture, so nothing of it is still to come.
                match (decoder.flush(), first_error) {
                    (Some(frame), _) => {
                        let picture = h264_picture(frame, *colours);
                        if !picture.is_whole() {
                            return Err("the decoder gave planes that do not fit its size".into());
                        }
                        Ok(vec![(job.sample, picture)])
                    }
                    (None, Some(reason)) => Err(reason),
                    (None, None) => Err("it holds no picture".into()),
                }
            }
            #[cfg(feature = "h265")]
            Self::H265(machine) => machine.decode(job.sample, &job.bytes, job.is_last),
        }
    }
}

fn h264_picture(frame: rust_h264::decoder::Frame, colours: Colours) -> Picture {
    let is_wide = frame.bytes_per_sample() == 2;
    let plane = |bytes: Vec<u8>| if is_wide { eight_bits(bytes) } else { bytes };
    let chroma_rows = match frame.chroma_format {
        rust_h264::decoder::ChromaFormat::Yuv420 => 1,
        rust_h264::decoder::ChromaFormat::Yuv422 => 0,
    };
    Picture {
        width: frame.width as usize,
        height: frame.height as usize,
        luma: plane(frame.y),
        chroma: [plane(frame.u), plane(frame.v)],
        chroma_shift: [1, chroma_rows],
        colours,
    }
}

/// Ten bits, little-endian, rounded to eight.
fn eight_bits(bytes: Vec<u8>) -> Vec<u8> {
    bytes.as_chunks::<2>().0.iter().map(|b| round_to_eight(u16::from_le_bytes(*b), 10)).collect()
}
