//! Reads the header of a `.safetensors` file: whether the file is complete, and its number of tensors.
//!
//! Eight bytes of length, that many bytes of JSON, then the data. The last offset must be the end of the file.

use crate::error::HubError;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Longest header that is read, bytes; official ones have about 200 kB.
const MOST_HEADER: u64 = 16 << 20;

/// Content of the header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Header {
    /// Tensors in the file.
    pub tensors: usize,
}

#[derive(Deserialize)]
struct Entry {
    data_offsets: Option<[u64; 2]>,
}

/// Reads and checks the header of a file.
pub(crate) fn read_header(path: &Path) -> Result<Header, HubError> {
    let mut file = File::open(path).map_err(HubError::io("read", path))?;
    let length = file.metadata().map_err(HubError::io("look at", path))?.len();
    let bad = |reason: String| HubError::NotACheckpoint { path: path.to_owned(), reason };
    let mut first = [0; 8];
    file.read_exact(&mut first)
        .map_err(|_| bad(format!("{length} bytes are too few for a safetensors file")))?;
    let size = u64::from_le_bytes(first);
    if size > MOST_HEADER || size.saturating_add(8) > length {
        return Err(bad(format!(
            "its header would have {size} bytes; it is not a safetensors file, or truncated"
        )));
    }
    let mut json = Vec::new();
    file.take(size).read_to_end(&mut json).map_err(HubError::io("read", path))?;
    parse(&json, length - 8 - size).map_err(bad)
}

fn parse(json: &[u8], data: u64) -> Result<Header, String> {
    let mut entries: BTreeMap<String, Entry> =
        serde_json::from_slice(json).map_err(|e| format!("its header is damaged: {e}"))?;
    entries.remove("__metadata__");
    let mut end = 0;
    for (name, entry) in &entries {
        let Some([from, to]) = entry.data_offsets else {
            return Err(format!("tensor {name:?} has no offsets"));
        };
        if from > to || to > data {
            return Err(format!("tensor {name:?} is at {from}..{to} of {data} bytes; the file is truncated"));
        }
        end = end.max(to);
    }
    if end != data {
        return Err(format!("its tensors end at byte {end} of {data}"));
    }
    Ok(Header { tensors: entries.len() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn tensors_are_counted_and_must_fill_the_file() {
        let json = br#"{"__metadata__":{"a":"b"},"x":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},
            "y":{"dtype":"F32","shape":[1],"data_offsets":[8,12]}}"#;
        assert_eq!(parse(json, 12), Ok(Header { tensors: 2 }));
        assert!(parse(json, 11).unwrap_err().contains("truncated"));
        assert!(parse(json, 13).unwrap_err().contains("end at byte 12 of 13"));
        assert!(parse(br#"{"x":{}}"#, 0).unwrap_err().contains("no offsets"));
        assert!(parse(br#"{"x":{"data_offsets":[8,4]}}"#, 8).is_err());
        assert_eq!(parse(b"{}", 0), Ok(Header { tensors: 0 }));
    }

    proptest! {
        #[test]
        fn no_header_panics(json in proptest::collection::vec(any::<u8>(), 0..200), data: u64) {
            let _ = parse(&json, data);
            let numbers = format!(r#"{{"x":{{"data_offsets":[{data},{}]}}}}"#, json.len());
            let _ = parse(numbers.as_bytes(), data);
        }
    }
}
