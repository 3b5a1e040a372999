//! The library's error type: one variant per `bk_result` code, each with a sentence that names the
//! argument and the value at fault.

use std::any::Any;
use std::fmt;

/// Reason why a call failed. The text is a full sentence for the developer who reads the log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Error {
    /// An argument is out of its documented range.
    InvalidArgument(String),
    /// The call is not allowed in the object's present state.
    InvalidState(String),
    /// Memory ran out, or a budget or the memory monitor refused.
    OutOfMemory(String),
    /// The progress callback asked to stop.
    Cancelled,
    /// This build or machine cannot do it.
    Unsupported(String),
    /// A file could not be read or written, or its content is malformed.
    Io(String),
    /// A bug in the library, caught at the boundary.
    Internal(String),
}

/// The library's result type.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// Converts the payload of a panic that was caught: an `Error` is returned as it is, a message becomes an
    /// internal error.
    pub(crate) fn of_panic(payload: Box<dyn Any + Send>) -> Error {
        let text = match payload.downcast::<Error>() {
            Ok(e) => return *e,
            Err(payload) => match payload.downcast::<String>() {
                Ok(text) => *text,
                Err(payload) => payload.downcast_ref::<&str>().copied().unwrap_or("no message").to_string(),
            },
        };
        Error::Internal(format!("a panic was caught: {text}"))
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Error::InvalidArgument(s) => write!(f, "invalid argument: {s}"),
            Error::InvalidState(s) => write!(f, "invalid state: {s}"),
            Error::OutOfMemory(s) => write!(f, "out of memory: {s}"),
            Error::Cancelled => write!(f, "cancelled by the progress callback"),
            Error::Unsupported(s) => write!(f, "unsupported: {s}"),
            Error::Io(s) => write!(f, "input/output: {s}"),
            Error::Internal(s) => write!(f, "internal error: {s}"),
        }
    }
}

impl std::error::Error for Error {}

/// Returns `Err(Error::InvalidArgument(format!(…)))`, the most frequent error.
macro_rules! invalid_argument {
    ($($arg:tt)*) => { Err($crate::base::error::Error::InvalidArgument(format!($($arg)*))) };
}
pub(crate) use invalid_argument;
