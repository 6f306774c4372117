//! Errors: a pointer to one, owned by the caller.

use std::ffi::{CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::ptr;
use vidar::Error;

/// Why a call failed. Free it with vidar_error_free.
pub struct VidarError {
    code: CString,
    message: CString,
    hint: Option<CString>,
}

/// Text for C: without zero bytes.
fn text(text: &str) -> CString {
    CString::new(text.replace('\0', " ")).unwrap_or_default()
}

impl VidarError {
    fn new(error: &Error) -> Self {
        let hint = error.hint().as_deref().map(text);
        Self { code: text(error.code()), message: text(&error.to_string()), hint }
    }

    fn bug() -> Self {
        Self { code: text("E7001"), message: text("this is a bug in VIDAR"), hint: None }
    }
}

/// An argument that cannot be used.
pub fn usage(what: impl Into<String>) -> Error {
    Error::Usage { what: what.into(), hint: "vidar.h describes every argument".into() }
}

/// Does `work`; an error, also a panic, goes to `error` (which may be null), and `failed` is returned.
///
/// # Safety
/// `error` is null or may be written to.
pub unsafe fn guarded<T>(
    error: *mut *mut VidarError,
    failed: T,
    work: impl FnOnce() -> Result<T, Error>,
) -> T {
    // What a panic leaves inconsistent belongs to the caller's handle, whose only further use is to be freed.
    let problem = match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(result)) => return result,
        Ok(Err(problem)) => VidarError::new(&problem),
        Err(_) => VidarError::bug(),
    };
    if !error.is_null() {
        // SAFETY: the caller's promise.
        unsafe { *error = Box::into_raw(Box::new(problem)) };
    }
    failed
}

/// Its code, such as "E0310"; `vidar explain CODE` explains it. Valid until the error is freed.
///
/// # Safety
/// `error` is null or an error of this library that is not freed yet.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_error_code(error: *const VidarError) -> *const c_char {
    // SAFETY: the caller's promise.
    unsafe { error.as_ref() }.map_or(ptr::null(), |e| e.code.as_ptr())
}

/// What went wrong, in words. Valid until the error is freed.
///
/// # Safety
/// As vidar_error_code.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_error_message(error: *const VidarError) -> *const c_char {
    // SAFETY: the caller's promise.
    unsafe { error.as_ref() }.map_or(ptr::null(), |e| e.message.as_ptr())
}

/// What to do about it; null where nothing is known. Valid until the error is freed.
///
/// # Safety
/// As vidar_error_code.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_error_hint(error: *const VidarError) -> *const c_char {
    // SAFETY: the caller's promise.
    let hint = unsafe { error.as_ref() }.and_then(|e| e.hint.as_ref());
    hint.map_or(ptr::null(), |h| h.as_ptr())
}

/// Frees an error; null is allowed.
///
/// # Safety
/// `error` is null or an error of this library that is not freed yet.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_error_free(error: *mut VidarError) {
    if !error.is_null() {
        // SAFETY: the caller's promise: it was made by `guarded`.
        drop(unsafe { Box::from_raw(error) });
    }
}
