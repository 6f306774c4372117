//! What `rmw_zenoh` attaches to a message: its number, when it was sent, by whom.
//!
//! Two layouts are in use. Both have the number and the time as 64-bit little-endian integers and the sender as a length and 16 bytes;
//! the older one puts the name of each field before it.

use crate::error::WireError;

const GID_BYTES: usize = 16;
/// With names: 3 lengths, 16 + 17 + 11 letters at most, both numbers, length and sender.
const MAX_BYTES: usize = 96;

/// The attachment of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Attachment {
    /// Number of the message among those of its sender.
    pub sequence: i64,
    /// When it was sent, ns, in the sender's clock.
    pub sent_ns: i64,
    /// Who sent it.
    pub sender: [u8; GID_BYTES],
}

impl Attachment {
    /// As current versions write it.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(33);
        bytes.extend(self.sequence.to_le_bytes());
        bytes.extend(self.sent_ns.to_le_bytes());
        bytes.push(GID_BYTES as u8);
        bytes.extend(self.sender);
        bytes
    }

    /// Reads either layout.
    ///
    /// # Errors
    /// The bytes are neither.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        crate::envelope::within("length of an attachment", bytes.len(), MAX_BYTES)?;
        let mut rest = bytes;
        let is_named = named("sequence_number", &mut rest);
        let sequence = i64::from_le_bytes(number(&mut rest)?);
        if is_named && !named("source_timestamp", &mut rest) {
            return Err(WireError::bad("attachment", "source_timestamp expected"));
        }
        let sent_ns = i64::from_le_bytes(number(&mut rest)?);
        if is_named && !named("source_gid", &mut rest) {
            return Err(WireError::bad("attachment", "source_gid expected"));
        }
        let [length] = number::<1>(&mut rest)?;
        if usize::from(length) != GID_BYTES {
            return Err(WireError::Length {
                what: "sender of an attachment",
                found: length.into(),
                expected: GID_BYTES,
            });
        }
        let sender = number(&mut rest)?;
        match rest.is_empty() {
            true => Ok(Self { sequence, sent_ns, sender }),
            false => Err(WireError::bad("attachment", format!("{} bytes behind its end", rest.len()))),
        }
    }
}

/// Whether a name with its length comes next; it is then passed.
fn named(name: &str, rest: &mut &[u8]) -> bool {
    let found = rest.split_first().filter(|(length, _)| usize::from(**length) == name.len());
    let behind = found.and_then(|(_, text)| text.strip_prefix(name.as_bytes()));
    behind.inspect(|behind| *rest = behind).is_some()
}

fn number<const N: usize>(rest: &mut &[u8]) -> Result<[u8; N], WireError> {
    let short = WireError::Length { what: "attachment", found: rest.len(), expected: N };
    let (number, behind) = rest.split_first_chunk::<N>().ok_or(short)?;
    *rest = behind;
    Ok(*number)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one() -> Attachment {
        Attachment {
            sequence: 7,
            sent_ns: 1_700_000_000_123_456_789,
            sender: std::array::from_fn(|i| i as u8),
        }
    }

    #[test]
    fn both_layouts_are_read() {
        let plain = one().encode();
        assert_eq!((plain.len(), Attachment::decode(&plain).unwrap()), (33, one()));
        let mut with_names = Vec::new();
        for (name, value) in [("sequence_number", &plain[..8]), ("source_timestamp", &plain[8..16])] {
            with_names.push(name.len() as u8);
            with_names.extend(name.as_bytes());
            with_names.extend(value);
        }
        with_names.push(10);
        with_names.extend(b"source_gid");
        with_names.extend(&plain[16..]);
        assert_eq!(Attachment::decode(&with_names).unwrap(), one());
        for length in 0..with_names.len() {
            assert!(Attachment::decode(&with_names[..length]).is_err(), "{length} bytes");
        }
        for length in 0..plain.len() {
            assert!(Attachment::decode(&plain[..length]).is_err(), "{length} bytes");
        }
        let longer = [plain, vec![0]].concat();
        assert!(Attachment::decode(&longer).is_err());
    }
}
