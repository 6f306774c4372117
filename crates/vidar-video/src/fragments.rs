//! Movies in fragments (ISO/IEC 14496-12, 8.8): tables of some seconds each, between the pictures. Recorders of screens, of streams and of
//! some phones write them, because such a file is whole up to the moment at which the recording broke off.

use crate::boxes::{Atom, atoms, find, u32_at, u64_at};
use crate::track::{Sample, Track};

/// Largest table of one fragment; one of ten seconds at 1 kHz has 160 kB.
pub(crate) const MAX_MOOF_BYTES: u64 = 64 << 20;

/// What samples of a track are where a fragment does not say: `trex`, then `tfhd`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Defaults {
    duration: u32,
    size: u32,
    flags: u32,
}

/// Puts the samples of fragments behind those of the movie's own tables.
pub(crate) struct Fragments<'a> {
    tracks: &'a mut [Track],
    /// By the number of the track.
    defaults: Vec<(u32, Defaults)>,
    /// Bytes that samples without a size of their own may still announce: they lie side by side, so all together are no longer than the file.
    bytes_left: u64,
}

/// `sample_is_non_sync_sample` (8.8.3.1).
const NEEDS_OTHERS: u32 = 1 << 16;

impl<'a> Fragments<'a> {
    /// For a movie that says (`mvex`) that fragments follow; `None` for others.
    pub(crate) fn announced(moov: &[u8], tracks: &'a mut [Track], file_bytes: u64) -> Option<Self> {
        let extends = atoms(find(moov, b"mvex")?).filter(|a| a.kind == *b"trex").filter_map(|a| {
            let at = |i: usize| u32_at(a.content, 4 + 4 * i);
            Some((at(0)?, Defaults { duration: at(2)?, size: at(3)?, flags: at(4)? }))
        });
        Some(Self { defaults: extends.collect(), tracks, bytes_left: file_bytes })
    }

    /// Adds the samples of one fragment; `start` is the place of its box `moof` in the file. The error is the reason as text.
    pub(crate) fn add(&mut self, moof: &[u8], start: u64) -> Result<(), String> {
        // Without a place of its own, the data of a track follow those of the track before it.
        let mut end_of_last = start;
        for traf in atoms(moof).filter(|a| a.kind == *b"traf") {
            end_of_last = self.add_track(traf.content, start, end_of_last)?;
        }
        Ok(())
    }

    /// Adds what one fragment holds of one track; gives the place where its data end.
    fn add_track(&mut self, traf: &[u8], start: u64, end_of_last: u64) -> Result<u64, String> {
        let cut = || "a fragment whose table is cut".to_string();
        let head = Head::read(find(traf, b"tfhd").ok_or_else(cut)?).ok_or_else(cut)?;
        let known = self.defaults.iter().find(|(id, _)| *id == head.track).map(|(_, d)| *d);
        let defaults = head.defaults(known.unwrap_or_default());
        let Some(track) = self.tracks.iter_mut().find(|t| t.id == head.track) else {
            return Ok(end_of_last);
        };
        if let Some(time) = find(traf, b"tfdt").and_then(decode_time) {
            track.next_ticks = time;
        }
        let base = match (head.base, head.is_from_moof) {
            (Some(base), _) => base,
            (None, true) => start,
            (None, false) => end_of_last,
        };
        let mut at = base;
        for run in atoms(traf).filter(|a| a.kind == *b"trun") {
            at = add_run(track, &run, (base, at), defaults, &mut self.bytes_left)?;
        }
        Ok(at)
    }
}

/// What `tfhd` says.
struct Head {
    track: u32,
    base: Option<u64>,
    is_from_moof: bool,
    duration: Option<u32>,
    size: Option<u32>,
    flags: Option<u32>,
}

impl Head {
    fn read(tfhd: &[u8]) -> Option<Self> {
        let stated = u32_at(tfhd, 0)? & 0xff_ffff;
        let mut at = 8;
        let base = (stated & 1 != 0).then(|| u64_at(tfhd, at));
        at += if base.is_some() { 8 } else { 0 };
        let mut field = |bit: u32| {
            let found = (stated & bit != 0).then(|| u32_at(tfhd, at));
            at += if found.is_some() { 4 } else { 0 };
            found
        };
        // The description of the codec is the first one in any case.
        let _ = field(0x2);
        let (duration, size, flags) = (field(0x8), field(0x10), field(0x20));
        Some(Self {
            track: u32_at(tfhd, 4)?,
            base: base.map_or(Some(None), |b| b.map(Some))?,
            is_from_moof: stated & 0x2_0000 != 0,
            duration: duration.map_or(Some(None), |d| d.map(Some))?,
            size: size.map_or(Some(None), |s| s.map(Some))?,
            flags: flags.map_or(Some(None), |f| f.map(Some))?,
        })
    }

    fn defaults(&self, known: Defaults) -> Defaults {
        Defaults {
            duration: self.duration.unwrap_or(known.duration),
            size: self.size.unwrap_or(known.size),
            flags: self.flags.unwrap_or(known.flags),
        }
    }
}

/// Decoding time of a fragment's first sample, in ticks of the track.
fn decode_time(tfdt: &[u8]) -> Option<i64> {
    match tfdt.first()? {
        1 => u64_at(tfdt, 4).and_then(|t| i64::try_from(t).ok()),
        _ => u32_at(tfdt, 4).map(i64::from),
    }
}

/// Adds the samples of one run (8.8.8): from the place that it states after `base`, else from where the run before it ended. Gives the
/// place where it ends.
fn add_run(
    track: &mut Track,
    run: &Atom<'_>,
    (base, after_last): (u64, u64),
    defaults: Defaults,
    bytes_left: &mut u64,
) -> Result<u64, String> {
    let cut = || "a fragment whose list of pictures is cut".to_string();
    let stated = u32_at(run.content, 0).ok_or_else(cut)? & 0xff_ffff;
    let count = u32_at(run.content, 4).ok_or_else(cut)?;
    let mut at = 8;
    let mut next = |is_there: bool| {
        let found = is_there.then(|| u32_at(run.content, at).ok_or_else(cut)).transpose();
        at += if is_there { 4 } else { 0 };
        found
    };
    let offset = next(stated & 0x1 != 0)?.map(|o| o as i32);
    let mut place =
        offset.map_or(Some(after_last), |o| base.checked_add_signed(i64::from(o))).ok_or_else(cut)?;
    let first_flags = next(stated & 0x4 != 0)?;
    for number in 0..count {
        let duration = next(stated & 0x100 != 0)?.unwrap_or(defaults.duration);
        let size = next(stated & 0x200 != 0)?.unwrap_or(defaults.size);
        let flags =
            next(stated & 0x400 != 0)?.or(first_flags.filter(|_| number == 0)).unwrap_or(defaults.flags);
        // Version 0 counts shifts without sign; writers use negative ones in both versions, as in `ctts`.
        let shift = next(stated & 0x800 != 0)?.unwrap_or(0) as i32;
        // What takes no byte of the table must take some of the file.
        if size == 0 && stated & 0x200 == 0 {
            return Err("a fragment with pictures of no size".into());
        }
        if stated & 0x200 == 0 {
            let left = bytes_left.checked_sub(u64::from(size));
            *bytes_left = left.ok_or("fragments whose pictures are longer than the file together")?;
        }
        track.push(
            Sample { offset: place, size, time_ns: 0, duration_ns: 0, is_sync: flags & NEEDS_OTHERS == 0 },
            i64::from(shift),
            duration,
        )?;
        place = place.checked_add(u64::from(size)).ok_or_else(cut)?;
    }
    Ok(place)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn atom(kind: &[u8; 4], content: &[u8]) -> Vec<u8> {
        [&(content.len() as u32 + 8).to_be_bytes(), kind.as_slice(), content].concat()
    }

    fn words(values: &[u32]) -> Vec<u8> {
        values.iter().flat_map(|v| v.to_be_bytes()).collect()
    }

    fn track(id: u32) -> Track {
        Track { id, scale: 1000, ..Track::default() }
    }

    fn trex(id: u32) -> Vec<u8> {
        atom(b"trex", &words(&[0, id, 1, 40, 7, NEEDS_OTHERS]))
    }

    #[test]
    fn runs_of_two_tracks_follow_each_other_and_defaults_fill_what_is_not_stated() {
        let moov = atom(b"mvex", &[trex(1), trex(2)].concat());
        let mut tracks = [track(1), track(2)];
        let mut fragments = Fragments::announced(&moov, &mut tracks, 1000).unwrap();
        // Track 1: three pictures of stated sizes with shifts, the first stands alone; its data are at the box + 200.
        let run = atom(b"trun", &words(&[0xa05, 3, 200, 0, 10, 80, 20, 0, 30, 40]));
        let first = [atom(b"tfhd", &words(&[0, 1])), atom(b"tfdt", &words(&[0, 4000])), run].concat();
        // Track 2: all by default, behind the data of track 1.
        let second = [atom(b"tfhd", &words(&[0, 2])), atom(b"trun", &words(&[0, 2]))].concat();
        let moof = [atom(b"traf", &first), atom(b"traf", &second)].concat();
        fragments.add(&moof, 500).unwrap();
        let places = |t: &Track| {
            t.samples.iter().map(|s| (s.offset, s.size, s.time_ns / 1_000_000)).collect::<Vec<_>>()
        };
        assert_eq!(places(&tracks[0]), [(700, 10, 4080), (710, 20, 4040), (730, 30, 4120)]);
        assert_eq!(places(&tracks[1]), [(760, 7, 0), (767, 7, 40)]);
        assert_eq!(tracks[0].samples.iter().map(|s| s.is_sync).collect::<Vec<_>>(), [true, false, false]);
        assert!(Fragments::announced(&atom(b"trak", &[]), &mut tracks, 0).is_none());
    }

    #[test]
    fn tables_that_announce_more_than_the_file_holds_are_refused() {
        let moov = atom(b"mvex", &trex(1));
        let mut tracks = [track(1)];
        let mut fragments = Fragments::announced(&moov, &mut tracks, 1000).unwrap();
        let moof = |tfhd: &[u32], run: &[u32]| {
            atom(b"traf", &[atom(b"tfhd", &words(tfhd)), atom(b"trun", &words(run))].concat())
        };
        // Four thousand million pictures of seven bytes each, and of none.
        assert!(
            fragments.add(&moof(&[0, 1], &[0, u32::MAX]), 0).unwrap_err().contains("longer than the file")
        );
        assert!(fragments.add(&moof(&[0x10, 1, 0], &[0, u32::MAX]), 0).unwrap_err().contains("no size"));
        assert!(fragments.add(&moof(&[0, 1], &[0x200, 3, 1]), 0).unwrap_err().contains("cut"));
        assert!(fragments.add(&moof(&[0x8], &[0, 1]), 0).unwrap_err().contains("cut"));
        assert!(tracks[0].samples.len() < 1000);
    }
}
