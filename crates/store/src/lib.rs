//! Opens a store beside the cache by its address: a folder's path, `file:///…`, or `s3://BUCKET/PREFIX`.
//!
//! The input is an address, and the output is a [`Remote`], which defines the operations of a store.
//! `use3d_workflow::remote` sends artifacts to one and fetches them. The program uses a network only here,
//! only with the feature `s3`, and only for the given address.

#[cfg(feature = "s3")]
mod bucket;
#[cfg(feature = "s3")]
mod profile;

use std::io;
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
pub fn open(address: &str) -> io::Result<Arc<dyn Remote>> {
    let shown = without_credentials(address);
    let wrong = |what: String| Err(io::Error::new(io::ErrorKind::InvalidInput, what));
    let Some((scheme, rest)) = address.split_once("://") else {
        if address.is_empty() {
            return wrong("an empty address: a folder or s3://BUCKET/PREFIX is expected".into());
        }
        return match std::path::absolute(address) {
            Ok(path) => Ok(Arc::new(FolderStore::new(&path))),
            Err(e) => wrong(format!("{address}: {e}")),
        };
    };
    match scheme {
        "file" => match Path::new(rest) {
            path if path.components().next() == Some(Component::RootDir) => {
                Ok(Arc::new(FolderStore::new(path)))
            }
            _ => wrong(format!("{shown}: write file:///ABSOLUTE/PATH")),
        },
        "s3" => {
            let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
            if bucket.contains(['@', ':', '?']) || prefix.contains('?') {
                return wrong(format!(
                    "{shown}: s3://BUCKET/PREFIX is expected, nothing more; keys come from AWS_ACCESS_KEY_ID and \
                     AWS_SECRET_ACCESS_KEY, another server's address from AWS_ENDPOINT_URL"
                ));
            }
            if bucket.is_empty() {
                return wrong(format!("{shown}: s3://BUCKET/PREFIX is expected"));
            }
            open_bucket(&shown, bucket, prefix.trim_matches('/'))
        }
        _ => wrong(format!(
            "{shown}: unknown kind of store; expected a folder, file:///PATH or s3://BUCKET/PREFIX"
        )),
    }
}

#[cfg(feature = "s3")]
fn open_bucket(shown: &str, bucket: &str, prefix: &str) -> io::Result<Arc<dyn Remote>> {
    let opened = bucket::Bucket::open(bucket, prefix);
    let opened = opened.map_err(|e| io::Error::new(e.kind(), format!("{shown}: {e}")))?;
    Ok(Arc::new(opened))
}

#[cfg(not(feature = "s3"))]
fn open_bucket(shown: &str, _: &str, _: &str) -> io::Result<Arc<dyn Remote>> {
    Err(io::Error::other(format!(
        "{shown}: this program was built without S3; build it with `cargo install --path crates/cli --features s3`, or give a \
         folder"
    )))
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
            let error = open(wrong).err().expect(wrong).to_string();
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
        let error = open("s3://bucket/prefix").err().expect("not there").to_string();
        assert!(error.contains("--features s3"), "{error}");
    }
}
