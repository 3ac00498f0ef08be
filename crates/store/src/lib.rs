//! Opens a store beside the cache by its address: a folder's path, `file:///…`, or `s3://BUCKET/PREFIX`.
//!
//! The input is an address, and the output is a [`Remote`], which defines the operations of a store.
//! `use3d_workflow::remote` sends artifacts to one and fetches them. The program uses a network only here,
//! only with the feature `s3`, and only for the given address.

#[cfg(feature = "s3")]
mod bucket;

use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use use3d_workflow::remote::{FolderStore, Remote};

/// The folder of an address, if the address is one of a folder.
pub fn folder(address: &str) -> Option<PathBuf> {
    match address.split_once("://") {
        None if address.is_empty() => None,
        None => std::path::absolute(address).ok(),
        Some(("file", rest)) => Some(PathBuf::from(rest)).filter(|path| path.has_root()),
        Some(_) => None,
    }
}

/// The store at an address.
///
/// # Errors
/// An address that cannot be parsed, or one that this program was built without; the message says what to do.
pub fn open(address: &str) -> Result<Arc<dyn Remote>, String> {
    let shown = without_credentials(address);
    let Some((scheme, rest)) = address.split_once("://") else {
        if address.is_empty() {
            return Err("an empty address: a folder or s3://BUCKET/PREFIX is expected".to_string());
        }
        let path = std::path::absolute(address).map_err(|e| format!("{address}: {e}"))?;
        return Ok(Arc::new(FolderStore::new(&path)));
    };
    match scheme {
        "file" => match Path::new(rest) {
            path if path.components().next() == Some(Component::RootDir) => {
                Ok(Arc::new(FolderStore::new(path)))
            }
            _ => Err(format!("{shown}: write file:///ABSOLUTE/PATH")),
        },
        "s3" => {
            let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
            if bucket.contains(['@', ':', '?']) || prefix.contains('?') {
                return Err(format!(
                    "{shown}: s3://BUCKET/PREFIX is expected, nothing more; keys come from AWS_ACCESS_KEY_ID and \
                     AWS_SECRET_ACCESS_KEY, another server's address from AWS_ENDPOINT_URL"
                ));
            }
            if bucket.is_empty() {
                return Err(format!("{shown}: s3://BUCKET/PREFIX is expected"));
            }
            open_bucket(&shown, bucket, prefix.trim_matches('/'))
        }
        _ => Err(format!(
            "{shown}: unknown kind of store; expected a folder, file:///PATH or s3://BUCKET/PREFIX"
        )),
    }
}

#[cfg(feature = "s3")]
fn open_bucket(shown: &str, bucket: &str, prefix: &str) -> Result<Arc<dyn Remote>, String> {
    let opened = bucket::Bucket::open(bucket, prefix).map_err(|e| format!("{shown}: {e}"))?;
    Ok(Arc::new(opened))
}

#[cfg(not(feature = "s3"))]
fn open_bucket(shown: &str, _: &str, _: &str) -> Result<Arc<dyn Remote>, String> {
    Err(format!(
        "{shown}: this program was built without S3; build it with `cargo install --path crates/cli --features s3`, or give a \
         folder"
    ))
}

/// An address without any part that may be a password, for messages.
fn without_credentials(address: &str) -> String {
    let (scheme, rest) = address.split_once("://").unwrap_or(("", address));
    let rest = rest.split('?').next().unwrap_or_default();
    let rest = rest.rsplit_once('@').map_or(rest, |(_, after)| after);
    if scheme.is_empty() { rest.to_string() } else { format!("{scheme}://{rest}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_says_which_store_and_no_message_says_a_password() {
        assert_eq!(open("/somewhere/store").expect("a folder").place(), "/somewhere/store");
        assert_eq!(open("file:///somewhere/store").expect("a folder").place(), "/somewhere/store");
        assert!(Path::new(&open("store").expect("a folder").place()).is_absolute());
        assert_eq!(folder("file:///somewhere/store"), Some(PathBuf::from("/somewhere/store")));
        assert!(folder("store").is_some_and(|path| path.is_absolute() && path.ends_with("store")));
        assert_eq!(["", "s3://bucket/store", "file://store"].map(folder), [None, None, None]);
        for (wrong, words) in [
            ("", "empty"),
            ("file://store", "file:///ABSOLUTE/PATH"),
            ("ftp://host/store", "unknown kind"),
            ("s3://", "s3://BUCKET/PREFIX"),
            ("s3://AKIA:secret@bucket/prefix", "AWS_SECRET_ACCESS_KEY"),
            ("s3://bucket/prefix?secret=secret", "AWS_SECRET_ACCESS_KEY"),
            ("https://AKIA:secret@host/bucket", "unknown kind"),
        ] {
            let error = open(wrong).err().expect(wrong);
            assert!(error.contains(words), "{wrong}: {error}");
            assert!(
                !error.contains("secret@") && !error.contains("=secret") && !error.contains("AKIA"),
                "{error}"
            );
        }
    }

    #[cfg(not(feature = "s3"))]
    #[test]
    fn without_s3_it_is_said_how_to_get_it() {
        let error = open("s3://bucket/prefix").err().expect("not there");
        assert!(error.contains("--features s3"), "{error}");
    }
}
