//! Images of a recording, decoded ahead of who takes them: several at a time, handed out in their order.

use crate::error::DatasetError;
use crate::isolated::BROKE_DOWN;
use crate::location::Location;
use crate::recording::{ImageEntry, Recording};
use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{Builder, JoinHandle, available_parallelism};
use vidar_core::FrameImage;
use vidar_video::DECODER_THREAD;

/// Most images decoded at a time: odometry takes longer for an image than a quarter of its decoding.
const MOST_THREADS: usize = 4;
/// Images that are ready or in work for each thread: one in work and one that waits.
const IMAGES_PER_THREAD: usize = 2;

type Loaded = Result<FrameImage, DatasetError>;

/// How an image is decoded, and where to hand it.
struct Job {
    decode: Box<dyn FnOnce() -> Loaded + Send>,
    done: SyncSender<Loaded>,
}

/// Threads that decode images of one recording. Every image is what [`Recording::load_image`] gives, whatever the number of threads.
pub(crate) struct Decoders {
    jobs: Option<SyncSender<Job>>,
    is_over: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Decoders {
    /// For images that do not depend on each other.
    pub(crate) fn for_images() -> Self {
        Self::start(available_parallelism().map_or(1, usize::from).min(MOST_THREADS))
    }

    fn start(count: usize) -> Self {
        // As many as are ever asked for, so that asking never waits.
        let (jobs, queue) = sync_channel::<Job>(MOST_THREADS * IMAGES_PER_THREAD);
        let (queue, is_over) = (Arc::new(Mutex::new(queue)), Arc::new(AtomicBool::new(false)));
        let spawn = |_| {
            let (queue, is_over) = (Arc::clone(&queue), Arc::clone(&is_over));
            let work = move || work(&queue, &is_over);
            Builder::new().name(DECODER_THREAD.into()).spawn(work).ok()
        };
        let threads = (0..count).filter_map(spawn).collect();
        Self { jobs: Some(jobs), is_over, threads }
    }

    /// The most images that may be asked for at a time; none where the system gives no threads.
    pub(crate) fn most_asked(&self) -> usize {
        IMAGES_PER_THREAD * self.threads.len()
    }

    pub(crate) fn ask(&self, decode: impl FnOnce() -> Loaded + Send + 'static) -> Receiver<Loaded> {
        let (done, answer) = sync_channel(1);
        if let Some(jobs) = &self.jobs {
            // Where all threads have ended the answer says so.
            let _ = jobs.send(Job { decode: Box::new(decode), done });
        }
        answer
    }
}

impl Drop for Decoders {
    /// Waits for the images in work, so that no thread outlives the recording.
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.jobs = None;
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}

fn work(queue: &Mutex<Receiver<Job>>, is_over: &AtomicBool) {
    loop {
        let next = queue.lock().unwrap_or_else(PoisonError::into_inner).recv();
        let Ok(Job { decode, done }) = next else { return };
        if is_over.load(Ordering::Relaxed) {
            return;
        }
        // A decoder's panic is the image's error already; nobody may wait for it any more.
        let _ = done.send(decode());
    }
}

fn broke_down(location: &Location) -> DatasetError {
    DatasetError::BadImage { path: location.place(), reason: BROKE_DOWN.into() }
}

/// Iterator of [`Recording::images_ahead`].
pub struct ImagesAhead<'a, I> {
    dataset: &'a Recording,
    entries: I,
    /// `None` until the first image is asked for.
    decoders: Option<Decoders>,
    asked: VecDeque<(&'a ImageEntry, Receiver<Loaded>)>,
}

impl Recording {
    /// The pixels of images in the order of `entries`, decoded on threads of their own ahead of who takes them. At most eight are in memory
    /// beside the one that is taken; a picture of a video, of which a decoder gives one after the other, is converted ahead, two at most.
    pub fn images_ahead<'a, I: Iterator<Item = &'a ImageEntry>>(&'a self, entries: I) -> ImagesAhead<'a, I> {
        ImagesAhead { dataset: self, entries, decoders: None, asked: VecDeque::new() }
    }
}

impl<'a, I: Iterator<Item = &'a ImageEntry>> Iterator for ImagesAhead<'a, I> {
    type Item = (&'a ImageEntry, Result<FrameImage, DatasetError>);

    fn next(&mut self) -> Option<Self::Item> {
        let media = &self.dataset.media;
        let decoders = self.decoders.get_or_insert_with(|| match media.is_video() {
            true => Decoders::start(1),
            false => Decoders::for_images(),
        });
        if decoders.threads.is_empty() {
            // The system gives no more threads.
            return self.entries.next().map(|entry| (entry, self.dataset.load_image(entry)));
        }
        while self.asked.len() < decoders.most_asked() {
            let Some(entry) = self.entries.next() else { break };
            let (media, location, size) =
                (media.clone(), entry.location.clone(), self.dataset.size_of(entry));
            self.asked.push_back((entry, decoders.ask(move || media.image_of_size(&location, size))));
        }
        let (entry, answer) = self.asked.pop_front()?;
        Some((entry, answer.recv().unwrap_or_else(|_| Err(broke_down(&entry.location)))))
    }
}
