//! The queue between Zenoh's threads and who takes the messages; it is bounded by bytes and by number.

use super::Sample;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

/// Bytes of messages that wait to be taken: 8 s of colour images of one megapixel at 10 Hz.
const MAX_WAITING_BYTES: usize = 256 << 20;
/// Messages that wait: a minute of an IMU of 1 kHz.
const MAX_WAITING: usize = 65_536;
/// Messages up to this size are only left out where there are too many of them; IMU samples are some 350 bytes.
const SMALL_BYTES: usize = 4096;

/// Messages that came and were not taken yet, within bounds.
#[derive(Default)]
pub(super) struct Waiting {
    inner: Mutex<Inner>,
    changed: Condvar,
    dropped: AtomicU64,
}

#[derive(Default)]
struct Inner {
    samples: VecDeque<Sample>,
    bytes: usize,
}

impl Waiting {
    /// Adds a message; a large one that comes where there is no room is left out, and counted.
    pub(super) fn add(&self, sample: Sample) {
        let size = sample.key.len() + sample.payload.len() + sample.attachment.as_ref().map_or(0, Vec::len);
        let mut inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
        let is_full = size > SMALL_BYTES && inner.bytes + size > MAX_WAITING_BYTES;
        if is_full || inner.samples.len() >= MAX_WAITING {
            self.dropped.fetch_add(1, Ordering::Relaxed);
            return;
        }
        inner.bytes += size;
        inner.samples.push_back(sample);
        self.changed.notify_one();
    }

    /// The next message, waited for up to a time.
    pub(super) fn take(&self, within: Duration) -> Option<Sample> {
        let inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.changed.wait_timeout_while(inner, within, |inner| inner.samples.is_empty());
        let mut inner = waited.map_or_else(|e| e.into_inner().0, |(inner, _)| inner);
        let sample = inner.samples.pop_front()?;
        inner.bytes -=
            sample.key.len() + sample.payload.len() + sample.attachment.as_ref().map_or(0, Vec::len);
        Some(sample)
    }

    /// Messages left out so far.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(bytes: usize) -> Sample {
        Sample { key: "k".into(), payload: vec![0; bytes], attachment: None }
    }

    #[test]
    fn what_waits_is_bounded_and_small_messages_survive_large_ones() {
        let waiting = Waiting::default();
        let image = 64 << 20;
        (0..5).for_each(|_| waiting.add(sample(image)));
        assert_eq!(waiting.dropped(), 2, "of five images three fit");
        (0..MAX_WAITING).for_each(|_| waiting.add(sample(8)));
        assert_eq!(waiting.dropped(), 5, "no more small ones than are stated");
        let sizes: Vec<usize> =
            std::iter::from_fn(|| waiting.take(Duration::ZERO)).map(|s| s.payload.len()).collect();
        assert_eq!((sizes.len(), sizes[2], sizes[3]), (MAX_WAITING, image, 8));
        assert_eq!(waiting.inner.lock().unwrap().bytes, 0);
    }
}
