//! A message: magic bytes with the version, the length of a header in CBOR, the header, planes of raw numbers.

use crate::error::WireError;
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Version of the protocol; a worker and an engine of different versions do not talk.
pub const PROTOCOL: u32 = 1;
/// The largest message, bytes: 200 colour views of 640×480, or 64 of one megapixel.
pub const MAX_MESSAGE_BYTES: usize = 192 << 20;
/// The largest header, bytes; a view takes some 500.
pub const MAX_HEADER_BYTES: usize = 1 << 20;

const MAGIC: [u8; 8] = *b"vidarln\x01";
const HEAD: usize = MAGIC.len() + 4;
/// Headers nest four levels.
const DEPTH: usize = 12;

/// Magic bytes and header; planes are appended.
pub(crate) fn begin<T: Serialize>(header: &T, plane_bytes: usize) -> Result<Vec<u8>, WireError> {
    let mut bytes = Vec::with_capacity(HEAD + (64 << 10) + plane_bytes);
    bytes.extend(MAGIC);
    bytes.extend([0; 4]);
    ciborium::into_writer(header, &mut bytes).map_err(|e| WireError::bad("header", e))?;
    let length = bytes.len() - HEAD;
    within("length of the header", length, MAX_HEADER_BYTES)?;
    within("length of the message", bytes.len() + plane_bytes, MAX_MESSAGE_BYTES)?;
    bytes[MAGIC.len()..HEAD].copy_from_slice(&(length as u32).to_le_bytes());
    Ok(bytes)
}

/// Header and planes of a message.
pub(crate) fn open<T: DeserializeOwned>(bytes: &[u8]) -> Result<(T, &[u8]), WireError> {
    within("length of the message", bytes.len(), MAX_MESSAGE_BYTES)?;
    let short = |found: usize, expected: usize| WireError::Length { what: "message", found, expected };
    let head = bytes.get(..HEAD).ok_or(short(bytes.len(), HEAD))?;
    if head[..MAGIC.len()] != MAGIC {
        return Err(WireError::OtherProtocol { expected: PROTOCOL });
    }
    let length = u32::from_le_bytes([head[8], head[9], head[10], head[11]]) as usize;
    within("length of the header", length, MAX_HEADER_BYTES)?;
    let header = bytes.get(HEAD..HEAD + length).ok_or(short(bytes.len(), HEAD + length))?;
    let mut rest = header;
    let value = ciborium::de::from_reader_with_recursion_limit(&mut rest, DEPTH);
    let value = value.map_err(|e| WireError::bad("header", e))?;
    if !rest.is_empty() {
        return Err(WireError::bad("header", format!("{} bytes behind its end", rest.len())));
    }
    Ok((value, &bytes[HEAD + length..]))
}

/// Refuses a number beyond its bound.
pub(crate) fn within(what: &'static str, found: usize, limit: usize) -> Result<(), WireError> {
    match found <= limit {
        true => Ok(()),
        false => Err(WireError::TooLarge { what, found: found as u64, limit: limit as u64 }),
    }
}
