//! One JSON document on standard output.

use serde::Serialize;

use crate::error::{CliError, Done};

/// Prints one JSON document.
pub(crate) fn json(value: &impl Serialize) -> Done {
    let text = serde_json::to_string_pretty(value).map_err(CliError::failed)?;
    println!("{text}");
    Ok(())
}
