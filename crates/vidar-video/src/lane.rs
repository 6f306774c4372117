//! A decoder on a thread of its own, ahead of who takes its pictures: a panic or a hang inside becomes an error of one picture.

use crate::picture::Picture;
use crate::unit::UnitDecoder;
use std::collections::HashSet;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// Where access units come from, in the order of decoding.
pub trait AccessUnits: Send + Sync {
    /// The bytes of a unit; the error is the reason as text.
    fn read(&self, number: usize) -> Result<Vec<u8>, String>;
}

/// Longest time for one picture. A picture of 1080p takes 0.04 s; one of 8K on a machine ten times slower stays below this, and a
/// decoder that needs longer hangs.
pub(crate) const PICTURE_LIMIT: Duration = Duration::from_secs(20);

/// Name of the thread, by which a program can tell its panics from others.
pub const DECODER_THREAD: &str = "vidar video decoder";

/// Makes a decoder at the beginning of a sequence.
pub(crate) type MakeDecoder = dyn Fn() -> Result<Box<dyn UnitDecoder>, String> + Send + Sync;

/// What a lane decodes.
#[derive(Clone)]
pub(crate) struct Work {
    pub units: Arc<dyn AccessUnits>,
    pub make: Arc<MakeDecoder>,
    /// Units whose pictures will be asked for; `None`: all.
    pub needed: Option<Arc<[bool]>>,
    /// Units on which a decoder broke down before; they are passed over.
    pub broken: HashSet<usize>,
    /// Columns and rows that the container states.
    pub stated_size: (usize, usize),
    /// Longest time for one unit.
    pub limit: Duration,
}

impl Work {
    pub(crate) fn is_needed(&self, unit: usize) -> bool {
        self.needed.as_ref().is_none_or(|needed| needed.get(unit).is_none_or(|n| *n))
    }
}

/// What came of one unit.
type Reply = Result<Vec<(usize, Picture)>, String>;

/// Why a unit gave no picture.
pub(crate) enum Failure {
    /// The decoder refused it and goes on.
    Refused(String),
    /// The decoder broke down or hangs, and this lane has ended.
    Ended(String),
}

/// A running decoder and the units of one sequence that it decodes in their order.
pub(crate) struct Lane {
    pub start: usize,
    pub end: usize,
    /// The unit whose reply is received next.
    pub next: usize,
    /// Units whose pictures were received.
    pub out: HashSet<usize>,
    limit: Duration,
    replies: Receiver<Reply>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    is_hung: bool,
}

impl Lane {
    /// Whether the decoder did not come back.
    pub(crate) fn is_hung(&self) -> bool {
        self.is_hung
    }

    /// Starts a decoder that keeps at most `ahead` units' pictures ready.
    pub(crate) fn start(work: Work, range: Range<usize>, ahead: usize) -> Result<Self, String> {
        let (done, replies) = sync_channel::<Reply>(ahead.max(1));
        let stop = Arc::new(AtomicBool::new(false));
        let (limit, Range { start, end }) = (work.limit, range.clone());
        let stopped = Arc::clone(&stop);
        let thread = std::thread::Builder::new().name(DECODER_THREAD.into());
        let spawned = thread.spawn(move || {
            let send = |reply| !stopped.load(Ordering::Relaxed) && done.send(reply).is_ok();
            let mut decoder = match (work.make)() {
                Ok(decoder) => decoder,
                // The same answer for every unit: these parameter sets cannot be decoded.
                Err(reason) => return range.clone().for_each(|_| _ = send(Err(reason.clone()))),
            };
            for unit in range.clone() {
                let reply = decode_one(&work, decoder.as_mut(), unit, unit + 1 == range.end);
                if !send(reply) {
                    return;
                }
            }
        });
        let thread = Some(spawned.map_err(|e| format!("no thread for the decoder: {e}"))?);
        Ok(Self {
            start,
            end,
            next: start,
            out: HashSet::new(),
            limit,
            replies,
            stop,
            thread,
            is_hung: false,
        })
    }

    /// Waits for what came of the next unit.
    pub(crate) fn receive(&mut self) -> Result<Vec<(usize, Picture)>, Failure> {
        let reply = self.replies.recv_timeout(self.limit);
        self.next += 1;
        match reply {
            Ok(Ok(pictures)) => {
                self.out.extend(pictures.iter().map(|(unit, _)| *unit));
                Ok(pictures)
            }
            Ok(Err(reason)) => Err(Failure::Refused(reason)),
            Err(RecvTimeoutError::Timeout) => {
                // It cannot be stopped from outside, and waiting for it would hang too.
                (self.thread, self.is_hung) = (None, true);
                let limit = self.limit.as_secs_f64();
                Err(Failure::Ended(format!("the decoder did not finish within {limit:.0} s")))
            }
            Err(RecvTimeoutError::Disconnected) => Err(Failure::Ended(
                "the decoder broke down on this frame (the video is damaged, or the decoder has a fault)"
                    .into(),
            )),
        }
    }
}

impl Drop for Lane {
    /// Waits until the thread has ended, so that none outlives the video; one that hangs is left behind after the limit.
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let Some(thread) = self.thread.take() else { return };
        loop {
            match self.replies.recv_timeout(self.limit) {
                Ok(_) => {}
                Err(RecvTimeoutError::Timeout) => return,
                Err(RecvTimeoutError::Disconnected) => return drop(thread.join()),
            }
        }
    }
}

fn decode_one(work: &Work, decoder: &mut dyn UnitDecoder, unit: usize, is_last: bool) -> Reply {
    if work.broken.contains(&unit) {
        return Err("a decoder broke down on it before".into());
    }
    let bytes = work.units.read(unit)?;
    // The last unit is decoded in any case, because what is held back comes with it.
    if !work.is_needed(unit) && !is_last && decoder.is_disposable(&bytes) {
        return Ok(Vec::new());
    }
    let pictures = decoder.decode(unit, &bytes, is_last)?;
    let wanted = pictures.into_iter().filter(|(unit, _)| work.is_needed(*unit));
    Ok(wanted.map(|(unit, picture)| (unit, picture.without_filling(work.stated_size))).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::Colours;
    use std::sync::Mutex;

    /// A decoder of made-up units: byte 0 is a picture, 1 hangs, 2 panics, 3 is a picture that nothing depends on.
    struct Fake(Arc<Mutex<Vec<usize>>>);

    impl UnitDecoder for Fake {
        fn is_disposable(&self, bytes: &[u8]) -> bool {
            bytes == [3]
        }

        fn decode(&mut self, unit: usize, bytes: &[u8], _: bool) -> Reply {
            self.0.lock().unwrap().push(unit);
            match bytes {
                [1] => std::thread::sleep(Duration::from_secs(5)),
                [2] => std::panic::resume_unwind(Box::new("a fault of the decoder")),
                _ => {}
            }
            let colours = Colours { is_full_range: true, is_bt709: true };
            let chroma = [vec![0], vec![0]];
            let (luma, chroma_shift) = (vec![unit as u8; 4], [1, 1]);
            Ok(vec![(unit, Picture { width: 2, height: 2, luma, chroma, chroma_shift, colours })])
        }
    }

    struct Units(Vec<u8>);

    impl AccessUnits for Units {
        fn read(&self, number: usize) -> Result<Vec<u8>, String> {
            Ok(vec![self.0[number]])
        }
    }

    fn lane(units: &[u8], needed: Option<&[bool]>, ahead: usize) -> (Lane, Arc<Mutex<Vec<usize>>>) {
        let seen = Arc::new(Mutex::new(Vec::new()));
        let decoded = Arc::clone(&seen);
        let work = Work {
            units: Arc::new(Units(units.to_vec())),
            make: Arc::new(move || Ok(Box::new(Fake(Arc::clone(&decoded))))),
            needed: needed.map(Arc::from),
            broken: HashSet::new(),
            stated_size: (2, 2),
            limit: Duration::from_secs(1),
        };
        (Lane::start(work, 0..units.len(), ahead).unwrap(), seen)
    }

    #[test]
    fn a_hang_and_a_panic_are_one_clear_error() {
        let (mut hangs, _) = lane(&[0, 1, 0], None, 1);
        assert!(hangs.receive().is_ok());
        let began = std::time::Instant::now();
        assert!(matches!(hangs.receive(), Err(Failure::Ended(e)) if e.contains("did not finish")));
        drop(hangs);
        assert!(began.elapsed() < Duration::from_secs(4), "a hang was waited for: {:?}", began.elapsed());
        let (mut panics, _) = lane(&[0, 2, 0], None, 1);
        assert!(panics.receive().is_ok());
        assert!(matches!(panics.receive(), Err(Failure::Ended(e)) if e.contains("broke down")));
    }

    #[test]
    fn what_nothing_depends_on_is_decoded_only_where_it_is_needed() {
        let (mut all, seen) = lane(&[0, 3, 3, 0], None, 1);
        let came: usize = (0..4).map(|_| all.receive().ok().unwrap().len()).sum();
        assert_eq!((came, seen.lock().unwrap().len()), (4, 4));
        let (mut thinned, seen) = lane(&[0, 3, 3, 0, 0], Some(&[true, false, true, false, true]), 1);
        let came: Vec<usize> = (0..5).map(|_| thinned.receive().ok().unwrap().len()).collect();
        assert_eq!((came, seen.lock().unwrap().clone()), (vec![1, 0, 1, 0, 1], vec![0, 2, 3, 4]));
    }

    #[test]
    fn a_lane_goes_ahead_only_as_far_as_its_queue_holds() {
        let (lane, seen) = lane(&[0; 40], None, 4);
        std::thread::sleep(Duration::from_millis(100));
        // Four wait in the queue and one in the hand.
        assert!(seen.lock().unwrap().len() <= 5, "{:?}", seen.lock().unwrap());
        drop(lane);
        assert!(seen.lock().unwrap().len() < 40);
    }
}
