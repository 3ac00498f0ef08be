//! The environment variables of the person who submits that tasks need: schedulers may start tasks without
//! them. Variables that may be secret are left out, because other people may be able to read the scripts.

use super::ClusterError;
use super::quote::one_line;

/// The variables of these names that are set, with their values. `warn` gets a sentence about every one that
/// tasks will lack.
///
/// # Errors
/// A script cannot hold a value.
pub fn for_tasks<'n>(
    names: impl Iterator<Item = &'n str>,
    warn: &mut dyn FnMut(String),
) -> Result<Vec<(String, String)>, ClusterError> {
    let mut found = Vec::new();
    for name in names {
        let Some(value) = std::env::var(name).ok().filter(|value| !value.is_empty()) else { continue };
        if may_be_secret(name) || !is_shell_name(name) {
            warn(format!(
                "the environment variable {name} is not written into scripts{}; make sure that \
                 tasks have it, for instance by `setup` of the site",
                if may_be_secret(name) { ", it may be a secret" } else { ", no shell knows such a name" }
            ));
            continue;
        }
        // The value is not named in the error, because it may contain a key.
        one_line(&value, || format!("the environment variable {name}"))?;
        found.push((name.to_string(), value));
    }
    Ok(found)
}

fn may_be_secret(name: &str) -> bool {
    let name = name.to_uppercase();
    name.starts_with("AWS_")
        || ["SECRET", "TOKEN", "PASSWORD", "CREDENTIAL", "_KEY"].iter().any(|part| name.contains(part))
}

fn is_shell_name(name: &str) -> bool {
    !name.starts_with(|c: char| c.is_ascii_digit())
        && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}
