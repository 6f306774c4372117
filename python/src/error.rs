//! Errors of VIDAR as exceptions, with the codes of the command line.

use pyo3::exceptions::PyException;
use pyo3::prelude::*;
use vidar::Error;

pyo3::create_exception!(
    vidar,
    VidarError,
    PyException,
    "An error of VIDAR, with the codes of the command line (`vidar explain E0208`).\n\n\
     Attributes: code (str), message (str), where (str or None: file, line or setting), hint (str or None: the next step),\n\
     exit_status (int: what the program would end with)."
);

/// The exception of an error.
pub fn raise(error: impl Into<Error>) -> PyErr {
    let error = error.into();
    Python::attach(|py| exception(py, &error).unwrap_or_else(|failure| failure))
}

fn exception(py: Python<'_>, error: &Error) -> PyResult<PyErr> {
    let exception = VidarError::new_err(format!("[{}] {error}", error.code()));
    let value = exception.value(py);
    let hint = error.hint();
    value.setattr("code", error.code())?;
    value.setattr("message", error.to_string())?;
    value.setattr("where", error.place())?;
    value.setattr("hint", &hint)?;
    value.setattr("exit_status", error.exit_status() as i32)?;
    // Notes are printed below the message; Python has them since 3.11.
    if let Some(hint) = hint.filter(|_| value.hasattr("add_note").unwrap_or(false)) {
        value.call_method1("add_note", (format!("hint: {hint}"),))?;
    }
    Ok(exception)
}
