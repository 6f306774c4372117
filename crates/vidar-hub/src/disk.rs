//! Free space on the disk.

use std::path::Path;

/// Bytes that this user may still write in the folder's file system; `None` if the system does not report it.
#[cfg(unix)]
pub(crate) fn free_bytes(folder: &Path) -> Option<u64> {
    let numbers = rustix::fs::statvfs(folder).ok()?;
    numbers.f_bavail.checked_mul(numbers.f_frsize)
}

/// Bytes that this user may still write in the folder's file system; `None` if the system does not report it.
#[cfg(not(unix))]
pub(crate) fn free_bytes(_folder: &Path) -> Option<u64> {
    None
}

#[cfg(all(test, unix))]
mod tests {
    #[test]
    fn free_space_is_reported_for_existing_folders_only() {
        assert!(super::free_bytes(&std::env::temp_dir()).is_some_and(|bytes| bytes > 0));
        assert_eq!(super::free_bytes("/no/such/folder".as_ref()), None);
    }
}
