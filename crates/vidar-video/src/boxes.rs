//! Boxes of ISO media files (ISO/IEC 14496-12), which mp4 and QuickTime's mov share.

/// A box: its kind and its content.
#[derive(Clone, Copy)]
pub(crate) struct Atom<'a> {
    pub kind: [u8; 4],
    pub content: &'a [u8],
}

/// The boxes that follow each other in `bytes`; ends at the first one that is not whole.
pub(crate) fn atoms(bytes: &[u8]) -> impl Iterator<Item = Atom<'_>> {
    let mut rest = bytes;
    std::iter::from_fn(move || {
        let (kind, head, length) = head(rest)?;
        let end = usize::try_from(if length == 0 { rest.len() as u64 } else { length }).ok()?;
        let content = rest.get(head..end)?;
        rest = &rest[end..];
        Some(Atom { kind, content })
    })
}

/// Kind, length of the head and length of the whole box; a length of 0 means "to the end".
pub(crate) fn head(bytes: &[u8]) -> Option<([u8; 4], usize, u64)> {
    let length = u32_at(bytes, 0)?;
    let kind = *bytes.get(4..)?.first_chunk()?;
    match length {
        0 => Some((kind, 8, 0)),
        1 => {
            let long = u64_at(bytes, 8)?;
            (long >= 16).then_some((kind, 16, long))
        }
        2..=7 => None,
        length => Some((kind, 8, u64::from(length))),
    }
}

/// The first box of a kind.
pub(crate) fn find<'a>(bytes: &'a [u8], kind: &[u8; 4]) -> Option<&'a [u8]> {
    atoms(bytes).find(|a| a.kind == *kind).map(|a| a.content)
}

/// The first box at a path of kinds.
pub(crate) fn find_in<'a>(bytes: &'a [u8], path: &[&[u8; 4]]) -> Option<&'a [u8]> {
    path.iter().try_fold(bytes, |inside, kind| find(inside, kind))
}

pub(crate) fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    bytes.get(at..)?.first_chunk().map(|b| u16::from_be_bytes(*b))
}

pub(crate) fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..)?.first_chunk().map(|b| u32::from_be_bytes(*b))
}

pub(crate) fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    bytes.get(at..)?.first_chunk().map(|b| u64::from_be_bytes(*b))
}
