//! S3 and servers with the same protocol, through `object_store`. Keys, region and server come from the usual
//! `AWS_…` variables and [files](crate::profile); none of them is ever written anywhere.

use std::io::{self, Read, Write};
use std::time::Duration;

use futures_util::StreamExt;
use object_store::aws::{AmazonS3, AmazonS3Builder, AmazonS3ConfigKey};
use object_store::path::Path;
use object_store::{
    BackoffConfig, ClientConfigKey, Error, MultipartUpload, ObjectStore, ObjectStoreExt, PutMode, PutOptions,
    PutPayload, RetryConfig,
};
use tokio::runtime::Runtime;
use use3d_workflow::remote::{Listed, Remote, RemoteError};

use crate::profile;

/// Larger objects are uploaded in parts of this size, in bytes.
const PART: u64 = 16 << 20;
/// The names that S3 gives to refusals of keys.
const DENIED: [&str; 4] = ["AccessDenied", "SignatureDoesNotMatch", "InvalidAccessKeyId", "ExpiredToken"];
/// The address at which a machine of the cloud answers who it is.
const IDENTITY: &str = "169.254.169.254";
/// Number of immediate retries if the server is busy; the caller retries later.
const RETRIES: usize = 3;

/// A bucket, or the part of it below a prefix.
pub(crate) struct Bucket {
    place: String,
    prefix: Path,
    store: AmazonS3,
    runtime: Runtime,
    has_keys: bool,
}

impl Bucket {
    pub(crate) fn open(bucket: &str, prefix: &str) -> io::Result<Self> {
        let retry = RetryConfig {
            backoff: BackoffConfig {
                init_backoff: Duration::from_millis(200),
                max_backoff: Duration::from_secs(5),
                base: 2.0,
            },
            max_retries: RETRIES,
            retry_timeout: Duration::from_secs(60),
        };
        // A large object may take long; the limit is on the time without new bytes.
        let client = |key| AmazonS3ConfigKey::Client(key);
        let mut builder = AmazonS3Builder::new()
            .with_config(client(ClientConfigKey::Timeout), "1 day")
            .with_config(client(ClientConfigKey::ReadTimeout), "60 seconds")
            .with_config(client(ClientConfigKey::ConnectTimeout), "10 seconds");
        let own = std::env::vars().filter(|(name, _)| name.starts_with("AWS_"));
        let of_files = profile::settings(&|name| std::env::var(name).ok())?;
        let settings: Vec<(String, String)> =
            own.chain(of_files.into_iter().map(|(name, value)| (name.to_string(), value))).collect();
        let has_keys = settings.iter().any(|(name, _)| name == "AWS_ACCESS_KEY_ID");
        for (name, value) in settings {
            let Ok(key) = name.to_ascii_lowercase().parse::<AmazonS3ConfigKey>() else { continue };
            // A server on this machine, or in a lab, often has no TLS; its address then begins with
            // `http://`.
            if matches!(key, AmazonS3ConfigKey::Endpoint | AmazonS3ConfigKey::S3Endpoint)
                && value.starts_with("http://")
            {
                builder = builder.with_allow_http(true);
            }
            builder = builder.with_config(key, value);
        }
        let store = builder.with_bucket_name(bucket).with_retry(retry).build().map_err(io::Error::other)?;
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime?;
        let place =
            if prefix.is_empty() { format!("s3://{bucket}") } else { format!("s3://{bucket}/{prefix}") };
        let prefix = Path::parse(prefix).map_err(io::Error::other)?;
        Ok(Self { place, prefix, store, runtime, has_keys })
    }

    fn at(&self, name: &str) -> Path {
        self.prefix.parts().chain(Path::from(name).parts()).collect()
    }

    fn refused(&self, doing: &'static str, name: &str, error: &Error) -> RemoteError {
        let said = error.to_string();
        // The library has no error of its own for a list that is refused.
        let is_denied = matches!(error, Error::Unauthenticated { .. } | Error::PermissionDenied { .. })
            || DENIED.iter().any(|code| said.contains(code));
        let passing = matches!(error, Error::Generic { .. } | Error::JoinError { .. }) && !is_denied;
        // Without keys the library asks the machine for an identity, at this address.
        if !is_denied && !self.has_keys && said.contains(IDENTITY) {
            let reason = "there are no keys: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE for a \
                          profile of ~/.aws/credentials; this machine has no identity in the cloud either";
            let (place, name) = (self.place.clone(), name.to_string());
            return RemoteError::Refused { place, doing, name, reason: reason.into(), passing: false };
        }
        let advice = if is_denied {
            "; check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY or AWS_PROFILE, and what they may do in this bucket"
        } else {
            ""
        };
        let (place, reason) = (self.place.clone(), format!("{}{advice}", without_xml(&said)));
        // The library has no error of its own for a bucket that does not exist; this is the name in S3's
        // answer.
        if reason.contains("NoSuchBucket") {
            return RemoteError::NoStore { place, reason };
        }
        RemoteError::Refused { place, doing, name: name.to_string(), reason, passing }
    }

    async fn upload(
        &self,
        upload: &mut Box<dyn MultipartUpload>,
        from: &mut (dyn Read + Send),
        mut first: Vec<u8>,
        name: &str,
    ) -> Result<(), RemoteError> {
        while !first.is_empty() {
            let sent = upload.put_part(PutPayload::from(first)).await;
            sent.map_err(|e| self.refused("write", name, &e))?;
            first = part(from)?;
        }
        match upload.complete().await {
            // The reply to a first attempt may have been lost: the upload is then finished and no longer
            // exists. The bucket may also have removed it.
            Err(Error::NotFound { source, .. }) => {
                let error = Error::Generic { store: "S3", source };
                Err(self.refused("write", name, &error))
            }
            done => done.map(drop).map_err(|e| self.refused("write", name, &e)),
        }
    }
}

/// The text of an error with the code and the message of a server in place of its XML.
fn without_xml(said: &str) -> String {
    let between = |tag: &str| {
        let (_, rest) = said.split_once(&format!("<{tag}>"))?;
        Some(rest.split_once(&format!("</{tag}>"))?.0)
    };
    let before = said.split(['<', '\n']).next().unwrap_or_default().trim_end_matches([' ', ':']);
    match (between("Code"), between("Message")) {
        (Some(code), Some(message)) => format!("{message} ({code})"),
        (Some(code), None) => code.to_string(),
        _ if said.contains("<?xml") || said.contains("<html") => before.to_string(),
        _ => said.to_string(),
    }
}

/// Reads the next part of an object; less at its end.
fn part(from: &mut (dyn Read + Send)) -> Result<Vec<u8>, RemoteError> {
    let mut bytes = Vec::new();
    from.take(PART).read_to_end(&mut bytes).map_err(RemoteError::Local)?;
    Ok(bytes)
}

impl Remote for Bucket {
    fn place(&self) -> String {
        self.place.clone()
    }

    fn get(&self, name: &str, to: &mut (dyn Write + Send)) -> Result<bool, RemoteError> {
        let path = self.at(name);
        self.runtime.block_on(async {
            let found = match self.store.get(&path).await {
                Ok(found) => found,
                Err(Error::NotFound { .. }) => return Ok(false),
                Err(e) => return Err(self.refused("read", name, &e)),
            };
            let mut pieces = found.into_stream();
            while let Some(piece) = pieces.next().await {
                let piece = piece.map_err(|e| self.refused("read", name, &e))?;
                to.write_all(&piece).map_err(RemoteError::Local)?;
            }
            Ok(true)
        })
    }

    fn size(&self, name: &str) -> Result<Option<u64>, RemoteError> {
        match self.runtime.block_on(self.store.head(&self.at(name))) {
            Ok(found) => Ok(Some(found.size)),
            Err(Error::NotFound { .. }) => Ok(None),
            Err(e) => Err(self.refused("look at", name, &e)),
        }
    }

    fn put(&self, name: &str, from: &mut (dyn Read + Send), size: u64) -> Result<(), RemoteError> {
        let path = self.at(name);
        let first = part(from)?;
        self.runtime.block_on(async {
            if size <= PART {
                // The reader checks the digest at the end of the data, so all of it is read before the
                // upload.
                let rest = part(from)?;
                let payload = PutPayload::from([first, rest].concat());
                return self
                    .store
                    .put(&path, payload)
                    .await
                    .map(drop)
                    .map_err(|e| self.refused("write", name, &e));
            }
            let upload = self.store.put_multipart(&path).await;
            let mut upload = upload.map_err(|e| self.refused("write", name, &e))?;
            let done = self.upload(&mut upload, from, first, name).await;
            if done.is_err() {
                // If this fails, the bucket's own rule for unfinished uploads applies.
                let _ = upload.abort().await;
            }
            done
        })
    }

    fn create(&self, name: &str, bytes: &[u8]) -> Result<bool, RemoteError> {
        let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        let payload = PutPayload::from(bytes.to_vec());
        match self.runtime.block_on(self.store.put_opts(&self.at(name), payload, options)) {
            Ok(_) => Ok(true),
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => Ok(false),
            Err(e) => Err(self.refused("create", name, &e)),
        }
    }

    fn list(&self, prefix: &str) -> Result<Vec<Listed>, RemoteError> {
        let below = self.prefix.parts().count();
        self.runtime.block_on(async {
            let mut pieces = self.store.list(Some(&self.at(prefix.trim_end_matches('/'))));
            let mut found = Vec::new();
            while let Some(piece) = pieces.next().await {
                let object = piece.map_err(|e| self.refused("list", prefix, &e))?;
                let name = object.location.parts().skip(below);
                let name = name.map(|part| part.as_ref().to_string()).collect::<Vec<_>>().join("/");
                found.push(Listed { name, size: object.size, written: object.last_modified.into() });
            }
            Ok(found)
        })
    }

    fn remove(&self, name: &str) -> Result<(), RemoteError> {
        match self.runtime.block_on(self.store.delete(&self.at(name))) {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(e) => Err(self.refused("remove", name, &e)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_in_xml_becomes_its_message() {
        let xml = "Generic S3 error: 404 Not Found: <?xml version=\"1.0\"?><Error><Code>NoSuchBucket</Code>\
            <Message>The specified bucket does not exist</Message><BucketName>x</BucketName></Error>";
        assert_eq!(without_xml(xml), "The specified bucket does not exist (NoSuchBucket)");
        assert_eq!(without_xml("502 Bad Gateway: <html><body>oops"), "502 Bad Gateway");
        assert_eq!(without_xml("connection refused"), "connection refused");
    }
}
