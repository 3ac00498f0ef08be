//! The source that decoders read from.

use std::io::{BufRead, Seek};

/// A file on disk or in memory. Decoders read from this one type, because each further type would compile all
/// of them again.
pub(crate) trait ByteSource: BufRead + Seek {}

impl<T: BufRead + Seek> ByteSource for T {}
