//! Tracks of a movie: where each sample lies and when it is shown (ISO/IEC 14496-12, 8.6 and 8.7).

use crate::boxes::{atoms, find, find_in, u16_at, u32_at, u64_at};

/// One sample: a coded picture, or a payload of telemetry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Sample {
    pub offset: u64,
    pub size: u32,
    /// When it is shown, ns after the movie's beginning.
    pub time_ns: i64,
    pub duration_ns: i64,
    /// Whether it can be decoded without the samples before it.
    pub is_sync: bool,
}

/// One track.
#[derive(Clone, Debug, Default)]
pub(crate) struct Track {
    /// Its number in the movie.
    pub id: u32,
    /// `vide`, `soun`, `meta`, ….
    pub handler: [u8; 4],
    /// `avc1`, `hvc1`, `gpmd`, ….
    pub codec: [u8; 4],
    /// The description of the codec: the boxes of its sample entry.
    pub entry: Vec<u8>,
    /// Columns and rows that the container states for the pictures.
    pub size: (usize, usize),
    /// Quarter turns clockwise by which pictures are shown.
    pub quarter_turns: u8,
    /// In the order of decoding.
    pub samples: Vec<Sample>,
    pub edits: Edits,
    /// Ticks a second.
    pub scale: u32,
    /// Decoding time of the sample after the last one, ticks.
    pub next_ticks: i64,
}

impl Track {
    /// Adds a sample behind the others, `shift` ticks after its decoding shown, and for so many ticks.
    pub(crate) fn push(&mut self, mut sample: Sample, shift: i64, duration: u32) -> Result<(), String> {
        if self.samples.len() as u64 == MAX_SAMPLES {
            return Err(format!("more than {MAX_SAMPLES} samples of a track"));
        }
        let scale = i64::from(self.scale.max(1));
        sample.time_ns = self.edits.time_ns(self.next_ticks.saturating_add(shift), scale);
        sample.duration_ns = (i128::from(duration) * 1_000_000_000 / i128::from(scale)) as i64;
        self.next_ticks = self.next_ticks.saturating_add(i64::from(duration));
        self.samples.push(sample);
        Ok(())
    }
}

/// Most samples of a track: ten hours at 1 kHz.
const MAX_SAMPLES: u64 = 36_000_000;
/// Length of a visual sample entry before its boxes.
const VISUAL_ENTRY_BYTES: usize = 78;

/// Reads a `trak` box; the error is the reason as text.
pub(crate) fn read(trak: &[u8], movie_scale: u32) -> Result<Track, String> {
    let need = |what: &'static str| move || format!("a track without {what}");
    let mdia = find(trak, b"mdia").ok_or_else(need("mdia"))?;
    let handler = find(mdia, b"hdlr").and_then(|h| h.get(8..12)?.try_into().ok()).ok_or_else(need("hdlr"))?;
    let scale = find(mdia, b"mdhd").and_then(time_scale).filter(|&s| s > 0).ok_or_else(need("mdhd"))?;
    let stbl = find_in(mdia, &[b"minf", b"stbl"]).ok_or_else(need("stbl"))?;
    let entry = find(stbl, b"stsd").and_then(|b| atoms(b.get(8..)?).next()).ok_or_else(need("stsd"))?;
    let header = find(trak, b"tkhd").unwrap_or_default();
    let tables = Tables {
        sizes: find(stbl, b"stsz").ok_or_else(need("stsz"))?,
        chunks: find(stbl, b"stsc").ok_or_else(need("stsc"))?,
        durations: find(stbl, b"stts").ok_or_else(need("stts"))?,
        offsets: find(stbl, b"stco").map(|b| (b, 4)).or_else(|| find(stbl, b"co64").map(|b| (b, 8))),
        shifts: find(stbl, b"ctts"),
        syncs: find(stbl, b"stss"),
    };
    let mut track = Track {
        id: u32_at(header, if header.first() == Some(&1) { 20 } else { 12 }).unwrap_or(0),
        handler,
        codec: entry.kind,
        entry: entry.content.get(VISUAL_ENTRY_BYTES..).unwrap_or_default().to_vec(),
        size: (side_at(entry.content, 24), side_at(entry.content, 26)),
        quarter_turns: quarter_turns(header),
        samples: Vec::new(),
        edits: Edits::read(trak, movie_scale),
        scale,
        next_ticks: 0,
    };
    tables.fill(&mut track)?;
    Ok(track)
}

/// A side of a visual sample entry; 0 where there is none.
fn side_at(entry: &[u8], at: usize) -> usize {
    u16_at(entry, at).map_or(0, usize::from)
}

/// Ticks per second in `mdhd` and `mvhd`.
pub(crate) fn time_scale(header: &[u8]) -> Option<u32> {
    u32_at(header, if *header.first()? == 1 { 20 } else { 12 })
}

/// Quarter turns from the matrix of `tkhd`; other matrices count as none.
fn quarter_turns(header: &[u8]) -> u8 {
    let at = if header.first() == Some(&1) { 52 } else { 40 };
    let number = |i: usize| u32_at(header, at + 4 * i).map_or(0, |v| (v as i32) >> 16);
    match [number(0), number(1), number(3), number(4)] {
        [0, 1, -1, 0] => 1,
        [-1, 0, 0, -1] => 2,
        [0, -1, 1, 0] => 3,
        _ => 0,
    }
}

/// What an edit list says: an empty beginning, and which media time is shown first.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Edits {
    /// Samples before this time are decoded and not shown.
    pub empty_ns: i64,
    first_ticks: i64,
    /// Whether it says more, which is not followed.
    pub is_complex: bool,
}

impl Edits {
    fn read(trak: &[u8], movie_scale: u32) -> Self {
        let mut edits = Self::default();
        let Some(list) = find_in(trak, &[b"edts", b"elst"]) else { return edits };
        let is_long = list.first() == Some(&1);
        let (count, step) = (u32_at(list, 4).unwrap_or(0) as usize, if is_long { 20 } else { 12 });
        let mut media = 0;
        for entry in list.get(8..).unwrap_or_default().chunks_exact(step).take(count) {
            let (duration, time) = if is_long {
                (u64_at(entry, 0).unwrap_or(0), u64_at(entry, 8).unwrap_or(0) as i64)
            } else {
                let time = u32_at(entry, 4).unwrap_or(0) as i32;
                (u64::from(u32_at(entry, 0).unwrap_or(0)), i64::from(time))
            };
            let rate = u32_at(entry, step - 4).unwrap_or(0x1_0000);
            if time < 0 && media == 0 {
                let secs = i128::from(duration) * 1_000_000_000 / i128::from(movie_scale.max(1));
                edits.empty_ns = edits.empty_ns.saturating_add(i64::try_from(secs).unwrap_or(i64::MAX));
            } else if media == 0 {
                (edits.first_ticks, media) = (time, 1);
                edits.is_complex |= rate != 0x1_0000;
            } else {
                edits.is_complex = true;
            }
        }
        edits
    }

    fn time_ns(&self, ticks: i64, scale: i64) -> i64 {
        let ns = (i128::from(ticks) - i128::from(self.first_ticks)) * 1_000_000_000 / i128::from(scale);
        i64::try_from(ns).unwrap_or(i64::MAX).saturating_add(self.empty_ns)
    }
}

/// The boxes from which samples follow.
struct Tables<'a> {
    sizes: &'a [u8],
    chunks: &'a [u8],
    durations: &'a [u8],
    /// Offsets of chunks, and bytes of each.
    offsets: Option<(&'a [u8], usize)>,
    shifts: Option<&'a [u8]>,
    syncs: Option<&'a [u8]>,
}

impl Tables<'_> {
    fn fill(&self, track: &mut Track) -> Result<(), String> {
        let one_size = u32_at(self.sizes, 4).unwrap_or(0);
        let count = u64::from(u32_at(self.sizes, 8).unwrap_or(0));
        // Sizes of their own take four bytes each in the file; one size for all takes none, so the limit holds.
        let held = self.sizes.len().saturating_sub(12) as u64 / 4;
        if count > MAX_SAMPLES || one_size == 0 && count > held {
            return Err(format!(
                "{count} samples announced, {held} sizes held; at most {MAX_SAMPLES} are read"
            ));
        }
        let places = self.places(count, one_size)?;
        let (mut durations, mut shifts) = (Runs::new(Some(self.durations)), Runs::new(self.shifts));
        let mut next_sync = 0usize;
        track.samples.reserve_exact(places.len());
        for (number, mut sample) in places.into_iter().enumerate() {
            let duration = durations.next().unwrap_or(0);
            // Version 0 counts shifts without sign; writers use negative ones in both versions.
            let shift = i64::from(shifts.next().unwrap_or(0) as i32);
            if let Some(syncs) = self.syncs {
                sample.is_sync = u32_at(syncs, 8 + 4 * next_sync) == u32::try_from(number + 1).ok();
                next_sync += usize::from(sample.is_sync);
            }
            track.push(sample, shift, duration)?;
        }
        Ok(())
    }

    /// Offsets and sizes.
    fn places(&self, count: u64, one_size: u32) -> Result<Vec<Sample>, String> {
        let (offsets, width) = self.offsets.ok_or("a track without offsets of its chunks")?;
        let runs = u32_at(self.chunks, 4).unwrap_or(0) as usize;
        let run = |i: usize| {
            let at = 8 + 12 * i;
            (i < runs).then(|| Some((u32_at(self.chunks, at)?, u32_at(self.chunks, at + 4)?))).flatten()
        };
        let chunks = (offsets.len().saturating_sub(8) / width).min(u32_at(offsets, 4).unwrap_or(0) as usize);
        let mut samples = Vec::new();
        let mut at_run = 0;
        for chunk in 0..chunks {
            while run(at_run + 1).is_some_and(|(first, _)| first as usize <= chunk + 1) {
                at_run += 1;
            }
            let in_chunk = run(at_run).map_or(0, |(_, samples)| samples);
            let at = 8 + width * chunk;
            let start = if width == 8 { u64_at(offsets, at) } else { u32_at(offsets, at).map(u64::from) };
            let mut offset = start.unwrap_or(u64::MAX);
            for _ in 0..in_chunk {
                let number = samples.len();
                if number as u64 == count {
                    return Ok(samples);
                }
                let size =
                    if one_size > 0 { one_size } else { u32_at(self.sizes, 12 + 4 * number).unwrap_or(0) };
                samples.push(Sample { offset, size, time_ns: 0, duration_ns: 0, is_sync: true });
                offset = offset.saturating_add(u64::from(size));
            }
        }
        Ok(samples)
    }
}

/// Values that are stored as runs of equal ones (`stts`, `ctts`).
struct Runs<'a> {
    table: Option<&'a [u8]>,
    at: usize,
    left: u32,
    value: u32,
}

impl<'a> Runs<'a> {
    fn new(table: Option<&'a [u8]>) -> Self {
        Self { table, at: 8, left: 0, value: 0 }
    }

    fn next(&mut self) -> Option<u32> {
        while self.left == 0 {
            let table = self.table?;
            (self.left, self.value) = (u32_at(table, self.at)?, u32_at(table, self.at + 4)?);
            self.at += 8;
        }
        self.left -= 1;
        Some(self.value)
    }
}
