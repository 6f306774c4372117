//! The bounded queue between the odometry and the map.

use crate::engine::{FrameStamp, PoseReport};
use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use vidar_core::Warning;

/// Images that wait for the map at most: 13 s at 20 Hz. A chunk that takes that long to predict is no live map.
pub(super) const CAPACITY: usize = 256;
/// Reports without images that are kept beyond it, so that the trajectory stays whole: 3 min at 20 Hz, some 40 MB with their keyframes.
pub(super) const MOST_REPORTS: usize = 4096;

/// What the odometry hands to the map.
pub(super) enum Item {
    /// Images that may become keyframes, with when each arrived, and the report that decides the pose of the last one; whether that one
    /// will be a keyframe.
    Tracked { images: Vec<(FrameStamp, Instant)>, report: Option<Box<PoseReport>>, is_keyframe: bool },
    /// Something to say.
    Warning(Warning),
}

impl Item {
    fn images(&self) -> usize {
        match self {
            Self::Tracked { images, .. } => images.len(),
            Self::Warning(_) => 0,
        }
    }

    fn keyframes(&self) -> usize {
        usize::from(matches!(self, Self::Tracked { is_keyframe: true, .. }))
    }
}

/// What waits in the queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Load {
    /// Images.
    pub images: usize,
    /// Images, reports and warnings.
    pub items: usize,
    /// How long the first of them has waited.
    pub delay: Duration,
    /// How long the keyframes among them will take, by what the last chunks took; zero before there is one.
    pub work: Duration,
}

/// The queue; both ends may close it.
#[derive(Default)]
pub(super) struct Queue {
    inner: Mutex<Inner>,
    changed: Condvar,
}

#[derive(Default)]
struct Inner {
    /// With when each came.
    items: VecDeque<(Item, Instant)>,
    images: usize,
    keyframes: usize,
    /// What a keyframe takes.
    cost: Duration,
    most_images: usize,
    is_closed: bool,
}

impl Queue {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What waits.
    pub fn load(&self) -> Load {
        let inner = self.lock();
        let delay = inner.items.front().map_or(Duration::ZERO, |(_, since)| since.elapsed());
        let keyframes = u32::try_from(inner.keyframes).unwrap_or(u32::MAX);
        let work = inner.cost.saturating_mul(keyframes);
        Load { images: inner.images, items: inner.items.len(), delay, work }
    }

    /// A chunk of so many keyframes took this long. Half of what is expected of the next one is from those before.
    pub fn took(&self, time: Duration, keyframes: usize) {
        let Some(cost) = u32::try_from(keyframes).ok().and_then(|n| time.checked_div(n)) else { return };
        let mut inner = self.lock();
        inner.cost = if inner.cost.is_zero() { cost } else { (inner.cost + cost) / 2 };
    }

    /// The most images that ever waited.
    pub fn most_images(&self) -> usize {
        self.lock().most_images
    }

    /// Adds an item at once; whether anybody will take it.
    pub fn push(&self, item: Item) -> bool {
        let mut inner = self.lock();
        if inner.is_closed {
            return false;
        }
        inner.images += item.images();
        inner.keyframes += item.keyframes();
        inner.most_images = inner.most_images.max(inner.images);
        inner.items.push_back((item, Instant::now()));
        self.changed.notify_all();
        true
    }

    /// Adds an item once there is room for it; whether anybody will take it.
    pub fn push_waiting(&self, item: Item) -> bool {
        let mut inner = self.lock();
        while inner.items.len() >= CAPACITY && !inner.is_closed {
            inner = self.changed.wait(inner).unwrap_or_else(PoisonError::into_inner);
        }
        drop(inner);
        self.push(item)
    }

    /// The next item; none once the queue is closed and empty.
    pub fn pop(&self) -> Option<Item> {
        let mut inner = self.lock();
        while inner.items.is_empty() && !inner.is_closed {
            inner = self.changed.wait(inner).unwrap_or_else(PoisonError::into_inner);
        }
        let (item, _) = inner.items.pop_front()?;
        inner.images -= item.images();
        inner.keyframes -= item.keyframes();
        self.changed.notify_all();
        Some(item)
    }

    /// Nothing more comes, or nobody takes it. Whatever thread ends, the other one is woken.
    pub fn close(&self) {
        self.lock().is_closed = true;
        self.changed.notify_all();
    }

    /// Waits until it is closed, for `time` at most; whether it is.
    pub fn is_closed_within(&self, time: Duration) -> bool {
        let inner = self.lock();
        let waited = self.changed.wait_timeout_while(inner, time, |inner| !inner.is_closed);
        waited.map_or(true, |(inner, _)| inner.is_closed)
    }
}

/// Closes a queue when it goes, also on the way of an error or a panic.
pub(super) struct Closing<'a>(pub &'a Queue);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::{CameraId, FrameId, Timestamp};

    fn image(i: u32) -> Item {
        let stamp =
            FrameStamp { frame_id: FrameId(i), time: Timestamp::from_nanos(i.into()), camera: CameraId(0) };
        Item::Tracked {
            images: vec![(stamp, Instant::now())],
            report: None,
            is_keyframe: i.is_multiple_of(4),
        }
    }

    #[test]
    fn who_may_wait_waits_for_room_and_who_may_not_does_not() {
        let queue = Queue::default();
        (0..CAPACITY as u32).for_each(|i| assert!(queue.push(image(i))));
        assert!(queue.push(image(9999)), "the queue never stops the odometry");
        assert_eq!((queue.load().images, queue.most_images()), (CAPACITY + 1, CAPACITY + 1));
        let taken = std::thread::scope(|scope| {
            let waiting = scope.spawn(|| queue.push_waiting(image(1)) && queue.push_waiting(image(2)));
            let taken = (0..CAPACITY + 3).filter(|_| queue.pop().is_some()).count();
            assert!(waiting.join().unwrap());
            taken
        });
        let nothing = Load { images: 0, items: 0, delay: Duration::ZERO, work: Duration::ZERO };
        assert_eq!((taken, queue.load()), (CAPACITY + 3, nothing));
        assert_eq!(queue.most_images(), CAPACITY + 1, "who waits adds nothing above the bound");
    }

    #[test]
    fn what_waits_takes_what_its_keyframes_took_before() {
        let queue = Queue::default();
        (0..12).for_each(|i| assert!(queue.push(image(i))));
        assert_eq!(queue.load().work, Duration::ZERO, "nothing is known before a chunk");
        queue.took(Duration::from_millis(800), 4);
        assert_eq!(queue.load().work, Duration::from_millis(600), "images 0, 4 and 8");
        queue.took(Duration::from_millis(400), 4);
        queue.took(Duration::from_millis(5), 0);
        queue.pop().unwrap();
        assert_eq!(queue.load().work, Duration::from_millis(300));
    }

    #[test]
    fn an_end_that_goes_wakes_the_other_one() {
        let queue = Queue::default();
        std::thread::scope(|scope| {
            let taker = scope.spawn(|| queue.pop().is_none());
            drop(Closing(&queue));
            assert!(taker.join().unwrap());
        });
        assert!(!queue.push(image(1)) && !queue.push_waiting(image(1)));
        let full = Queue::default();
        (0..CAPACITY as u32).for_each(|i| assert!(full.push(image(i))));
        std::thread::scope(|scope| {
            let giver = scope.spawn(|| full.push_waiting(image(1)));
            drop(Closing(&full));
            assert!(!giver.join().unwrap());
        });
        assert!(full.pop().is_some(), "what is in it is still there");
    }
}
