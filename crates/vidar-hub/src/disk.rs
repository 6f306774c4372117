//! How much room there is.

use std::path::Path;

/// Bytes that this user may still write in the folder's file system; `None` where the system does not say.
#[cfg(unix)]
pub(crate) fn free_bytes(folder: &Path) -> Option<u64> {
    let numbers = rustix::fs::statvfs(folder).ok()?;
    numbers.f_bavail.checked_mul(numbers.f_frsize)
}

/// Bytes that this user may still write in the folder's file system; `None` where the system does not say.
#[cfg(not(unix))]
pub(crate) fn free_bytes(_folder: &Path) -> Option<u64> {
    None
}

#[cfg(all(test, unix))]
mod tests {
    #[test]
    fn a_folder_that_exists_has_room_and_one_that_does_not_has_no_answer() {
        assert!(super::free_bytes(&std::env::temp_dir()).is_some_and(|bytes| bytes > 0));
        assert_eq!(super::free_bytes("/no/such/folder".as_ref()), None);
    }
}
