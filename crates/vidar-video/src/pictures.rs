//! Pictures of a coded sequence by number: two decoders side by side while they are asked for in order, one for all else.
//!
//! The sequence is cut where a picture stands alone and nothing before it is shown after it (a closed group of pictures). What follows
//! a cut needs nothing from before, so the group after the one that is being read is decoded beside it. Every picture is a function of
//! its group alone: neither the number of threads nor the order of asking changes a bit.

use crate::codec::Codec;
use crate::lane::{AccessUnits, Failure, Lane, PICTURE_LIMIT, Work};
use crate::picture::Picture;
use std::collections::{HashSet, VecDeque};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

/// What is known of an access unit before it is decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Unit {
    /// When its picture is shown; only the order counts.
    pub time_ns: i64,
    /// Whether it can be decoded without the units before it.
    pub is_sync: bool,
}

/// The pictures of a coded sequence.
pub(crate) struct Pictures {
    units: Vec<Unit>,
    /// Starts of the groups, ascending; the first is 0.
    groups: Vec<usize>,
    most_held_back: usize,
    state: Mutex<State>,
}

struct State {
    work: Work,
    /// Where pictures are taken from in order, and the group after it.
    current: Option<Lane>,
    following: Option<Lane>,
    /// Where earlier pictures are taken from, so that looking back does not stop the reading in order.
    aside: Option<Lane>,
    /// Pictures taken from `current` since it was started out of order, and from `aside` since `current` gave one.
    in_order: usize,
    looking_back: usize,
    hangs: usize,
    /// Bytes of a picture.
    picture_bytes: usize,
    recent: VecDeque<(usize, Arc<Picture>)>,
}

/// Decoded pictures that are kept, bytes: twenty of 1080p. The newest stays even when it is larger.
const RECENT_BYTES: usize = 64 << 20;
/// Decoded pictures that wait in the group that follows, bytes: thirty of 1080p, a group of most phones.
const AHEAD_BYTES: usize = 96 << 20;
/// Most pictures that wait, however small.
const MOST_AHEAD: usize = 64;
/// Smaller groups are put together: a decoder's start costs about as much as a picture.
const SMALLEST_GROUP: usize = 8;
/// Pictures in order after which they are taken to be read in order: the group that follows is decoded then.
const READS_IN_ORDER: usize = 3;
/// Pictures looked back at after which the recording is being read again from an earlier place.
const READS_AGAIN: usize = 8;
/// Hangs after which no more of the sequence is decoded: each keeps a processor busy until the program ends.
const MOST_HANGS: usize = 2;

impl Pictures {
    pub(crate) fn new(
        codec: Codec,
        units: Vec<Unit>,
        source: Arc<dyn AccessUnits>,
        stated_size: (usize, usize),
    ) -> Self {
        let most_held_back = codec.most_held_back();
        let work = Work {
            units: source,
            make: Arc::new(move || codec.decoder()),
            needed: None,
            broken: HashSet::new(),
            stated_size,
            limit: PICTURE_LIMIT,
        };
        Self::with_work(work, units, most_held_back)
    }

    fn with_work(work: Work, units: Vec<Unit>, most_held_back: usize) -> Self {
        let state = State {
            work,
            current: None,
            following: None,
            aside: None,
            in_order: 0,
            looking_back: 0,
            hangs: 0,
            picture_bytes: 1,
            recent: VecDeque::new(),
        };
        Self { groups: groups(&units), units, most_held_back, state: Mutex::new(state) }
    }

    /// Says which pictures will be asked for; what these do not need is no longer decoded.
    pub(crate) fn expect(&self, wanted: impl Iterator<Item = usize>) {
        let mut needed = vec![false; self.units.len()];
        wanted.for_each(|unit| needed.get_mut(unit).into_iter().for_each(|n| *n = true));
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let state = &mut *state;
        state.work.needed = needed.contains(&false).then(|| needed.into());
        (state.current, state.following, state.aside) = (None, None, None);
    }

    /// Decodes the picture of a unit; the error is the reason as text.
    pub(crate) fn picture(&self, wanted: usize) -> Result<Arc<Picture>, String> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, picture)) = state.recent.iter().find(|(unit, _)| *unit == wanted) {
            return Ok(Arc::clone(picture));
        }
        if state.hangs >= MOST_HANGS {
            return Err(format!("the decoder hung on {MOST_HANGS} pictures, and the rest is not decoded"));
        }
        if !state.work.is_needed(wanted) {
            // What was said to be enough was not.
            state.work.needed = None;
            (state.current, state.following, state.aside) = (None, None, None);
        }
        if state.following.as_ref().is_some_and(|lane| self.gives(lane, wanted)) {
            state.current = state.following.take();
        }
        let is_behind = state.current.as_ref().is_some_and(|lane| wanted < lane.next);
        if !is_behind || state.current.as_ref().is_some_and(|lane| self.gives(lane, wanted)) {
            return self.take_in_order(&mut state, wanted);
        }
        self.take_aside(&mut state, wanted)
    }

    fn take_in_order(&self, state: &mut State, wanted: usize) -> Result<Arc<Picture>, String> {
        state.looking_back = 0;
        state.in_order += 1;
        if !state.current.as_ref().is_some_and(|lane| self.gives(lane, wanted)) {
            (state.current, state.following, state.in_order) = (None, None, 1);
            state.current = Some(Lane::start(state.work.clone(), self.range_for(state, wanted), 1)?);
        }
        self.follow(state)?;
        let Some(mut lane) = state.current.take() else { return Err("no decoder".into()) };
        let taken = self.take(state, &mut lane, wanted);
        state.current = taken.as_ref().map_or_else(|e| !e.has_ended, |_| true).then_some(lane);
        taken.map_err(|e| e.reason)
    }

    fn take_aside(&self, state: &mut State, wanted: usize) -> Result<Arc<Picture>, String> {
        state.looking_back += 1;
        let lane = match state.aside.take() {
            Some(lane) if self.gives(&lane, wanted) => Ok(lane),
            _ => Lane::start(state.work.clone(), self.range_for(state, wanted), 1),
        };
        let mut lane = lane?;
        let taken = self.take(state, &mut lane, wanted);
        if taken.as_ref().map_or_else(|e| !e.has_ended, |_| true) {
            state.aside = Some(lane);
        }
        if state.looking_back >= READS_AGAIN {
            (state.current, state.following, state.in_order) = (state.aside.take(), None, READS_IN_ORDER);
        }
        taken.map_err(|e| e.reason)
    }

    /// Starts the group after the current one, where pictures are read in order.
    fn follow(&self, state: &mut State) -> Result<(), String> {
        let Some(end) = state.current.as_ref().map(|lane| self.group_of(lane.start).end) else {
            return Ok(());
        };
        if state.in_order < READS_IN_ORDER || state.following.is_some() {
            return Ok(());
        }
        let Some(first) = (end..self.units.len()).find(|&unit| state.work.is_needed(unit)) else {
            return Ok(());
        };
        let ahead = (AHEAD_BYTES / state.picture_bytes.max(1)).clamp(1, MOST_AHEAD);
        state.following = Some(Lane::start(state.work.clone(), self.range_for(state, first), ahead)?);
        Ok(())
    }

    /// Whether a lane can give a picture without starting anew.
    fn gives(&self, lane: &Lane, wanted: usize) -> bool {
        if !(lane.start..lane.end).contains(&wanted) || lane.out.contains(&wanted) {
            return false;
        }
        if wanted < lane.next {
            // Given to the decoder, and still held back.
            return lane.next <= wanted + self.most_held_back;
        }
        // On from where the decoder is, unless a picture that stands alone lies between.
        self.start_of(wanted) <= lane.next
    }

    /// Takes replies from a lane until the wanted picture has come.
    fn take(&self, state: &mut State, lane: &mut Lane, wanted: usize) -> Result<Arc<Picture>, NoPicture> {
        let mut reason = "the decoder gave no picture for it".to_string();
        while lane.next < lane.end.min(wanted + 1 + self.most_held_back) {
            let at = lane.next;
            match lane.receive() {
                Ok(pictures) => {
                    let mut found = None;
                    for (unit, picture) in pictures {
                        let picture = Arc::new(picture);
                        if unit == wanted {
                            found = Some(Arc::clone(&picture));
                        }
                        state.picture_bytes = picture.bytes();
                        state.recent.push_back((unit, picture));
                    }
                    state.keep_few();
                    if let Some(found) = found {
                        return Ok(found);
                    }
                }
                Err(Failure::Refused(why)) if at == wanted => reason = why,
                Err(Failure::Refused(_)) => {}
                Err(Failure::Ended(reason)) => {
                    // A lane that ended by itself left a thread only where it hangs.
                    state.hangs += usize::from(lane.is_hung());
                    state.work.broken.insert(at);
                    return Err(NoPicture { reason, has_ended: true });
                }
            }
        }
        Err(NoPicture { reason, has_ended: false })
    }

    /// The units to decode for a picture and the needed ones after it in its group.
    fn range_for(&self, state: &State, wanted: usize) -> Range<usize> {
        let group = self.group_of(wanted);
        let last = group.clone().rev().find(|&unit| state.work.is_needed(unit)).unwrap_or(wanted);
        self.start_of(wanted)..last.max(wanted) + 1
    }

    /// Where decoding starts for a picture. One that is shown before the one that stands alone, and stored after it, needs the pictures
    /// before both.
    fn start_of(&self, wanted: usize) -> usize {
        let (group, time) = (self.group_of(wanted), self.units[wanted].time_ns);
        let stands_before = |&i: &usize| self.units[i].is_sync && self.units[i].time_ns <= time;
        (group.start..=wanted).rev().find(stands_before).unwrap_or(group.start)
    }

    fn group_of(&self, unit: usize) -> Range<usize> {
        let after = self.groups.partition_point(|&start| start <= unit);
        let start = after.checked_sub(1).and_then(|i| self.groups.get(i)).copied().unwrap_or(0);
        start..self.groups.get(after).copied().unwrap_or(self.units.len())
    }
}

struct NoPicture {
    reason: String,
    /// Whether the lane has to be started anew.
    has_ended: bool,
}

impl State {
    fn keep_few(&mut self) {
        let mut held: usize = self.recent.iter().map(|(_, p)| p.bytes()).sum();
        while held > RECENT_BYTES && self.recent.len() > 1 {
            held -= self.recent.pop_front().map_or(0, |(_, p)| p.bytes());
        }
    }
}

/// Starts of groups that need nothing from before: at a picture that stands alone, and that is shown after all before it and before all
/// after it.
fn groups(units: &[Unit]) -> Vec<usize> {
    let mut earliest_after = vec![i64::MAX; units.len() + 1];
    for (i, unit) in units.iter().enumerate().rev() {
        earliest_after[i] = unit.time_ns.min(earliest_after[i + 1]);
    }
    let (mut starts, mut latest) = (vec![0], i64::MIN);
    for (i, unit) in units.iter().enumerate() {
        let is_cut = unit.is_sync && latest < unit.time_ns && unit.time_ns <= earliest_after[i];
        if is_cut && starts.last().is_some_and(|start| i - start >= SMALLEST_GROUP) {
            starts.push(i);
        }
        latest = latest.max(unit.time_ns);
    }
    starts
}

#[cfg(test)]
mod tests;
