//! Tests with a bucket of a real S3 server, if one is given in `USE3D_S3`; moto's server is enough:
//!
//! ```text
//! pip install 'moto[server]' && moto_server -p 5555 & curl -X PUT http://127.0.0.1:5555/use3d-test
//! AWS_ENDPOINT_URL=http://127.0.0.1:5555 AWS_ACCESS_KEY_ID=any AWS_SECRET_ACCESS_KEY=any \
//!     AWS_REGION=us-east-1 USE3D_S3=s3://use3d-test/here \
//!     cargo test -p use3d-store --features s3 --test s3 -- --nocapture
//! ```
//!
//! Results are computed in one cache and fetched into another. Then the same happens through a [server that
//! fails](faults) in all the ways in which servers fail.
#![cfg(feature = "s3")]

mod faults;

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Read};
use std::path::Path;
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

use faults::{Fault, Proxy};
use use3d_workflow::code::CodeTable;
use use3d_workflow::remote::{Remote, RemoteError, RemoteStore};
use use3d_workflow::{
    Batch, BatchScene, Builder, Cache, Graph, Listener, Registry, RunOptions, Scope, Silent, Stage,
};

/// Set if the server returns nothing usable: everything is computed.
const USELESS: &str = "USE3D_S3_USELESS";

fn remote() -> Option<Arc<dyn Remote>> {
    let Ok(address) = std::env::var("USE3D_S3") else {
        println!("SKIPPED, nothing was tested with a real S3: set USE3D_S3=s3://BUCKET/PREFIX and AWS_…");
        return None;
    };
    Some(use3d_store::open(&address).expect("an address"))
}

fn read(remote: &dyn Remote, name: &str) -> Option<Vec<u8>> {
    let mut found = Vec::new();
    remote.get(name, &mut found).expect("an answer").then_some(found)
}

/// Two stages whose artifacts have a small file and a large one that is uploaded in parts; their keys are
/// unique to this process.
fn builder(folder: &Path) -> Builder {
    type Nothing = BTreeMap<String, u8>;
    let number = std::process::id().to_string();
    let make = Stage::new("make", Scope::Scene, move |context, _: &Nothing| {
        fs::create_dir(context.output().join("deep"))?;
        fs::write(context.output().join("deep/number"), &number)?;
        Ok(fs::write(context.output().join("large"), number.repeat(17 << 20).split_at(17 << 20).0)?)
    });
    let copy = Stage::new("copy", Scope::Scene, |context, _: &Nothing| {
        let from = context.input("made")?.join("large");
        Ok(fs::write(context.output().join("copy"), fs::read(from)?)?)
    });
    let stages = vec![make.made_of(&[], &[]), copy.input("made", "make").made_of(&[], &[])];
    let registry = Registry::new(stages, &CodeTable::default()).expect("a table");
    let mut builder = Builder::new(registry, Cache::open(folder, false).expect("a cache"));
    builder.numeric_class = format!("test {}", std::process::id());
    builder
}

#[test]
fn what_is_computed_here_is_fetched_there() {
    let Some(remote) = remote() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let store = Arc::new(RemoteStore::new(remote));
    let useless = std::env::var_os(USELESS).is_some();
    let probed = store.probe(&AtomicBool::new(false));
    assert_eq!(probed.is_err(), useless, "{probed:?}");
    let listener: Arc<dyn Listener> = Arc::new(Silent);
    let mut batch = Batch { name: "words".to_string(), ..Batch::default() };
    batch.scenes.push(BatchScene { name: "reef".to_string(), ..BatchScene::default() });
    let mut bytes = Vec::new();
    for (name, computed) in [("here", 2), ("there", if useless { 2 } else { 0 })] {
        let builder = builder(&folder.path().join(name)).with_remote(store.clone());
        let graph = Graph::new(&builder.registry, &batch).expect("a graph");
        let summary = builder.run(&graph, &RunOptions::default(), &listener);
        assert_eq!((summary.exit_code(), summary.done()), (0, computed), "{name}");
        // Manifests contain the time of the computation: they are equal if it happened once.
        let manifest = if useless { "" } else { "manifest.json" };
        let read = |(_, _, path): (String, _, std::path::PathBuf)| {
            [manifest, "deep/number", "large", "copy"]
                .map(|file| fs::read(path.join(file)).unwrap_or_default())
        };
        bytes.push(builder.cache.artifacts().into_iter().map(read).collect::<Vec<_>>());
    }
    assert!(bytes[0].len() == 2 && bytes[0] == bytes[1], "every byte");
}

#[test]
fn whatever_a_server_does_results_are_right() {
    if remote().is_none() {
        return;
    }
    let endpoint = std::env::var("AWS_ENDPOINT_URL")
        .expect("the server of USE3D_S3, without TLS: AWS_ENDPOINT_URL=http://…");
    for fault in Fault::ALL {
        let proxy = Proxy::start(&endpoint, fault);
        let start = std::time::Instant::now();
        let mut child = Command::new(std::env::current_exe().expect("this test"));
        child.args(["--exact", "what_is_computed_here_is_fetched_there", "--nocapture"]);
        child.env("AWS_ENDPOINT_URL", proxy.address());
        if fault.is_lasting() {
            child.env(USELESS, "1");
        }
        let output = child.output().expect("the test starts");
        let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
        let (requests, failed) = proxy.counts();
        println!("{fault:?}: {failed} of {requests} requests failed, {:.0} s", start.elapsed().as_secs_f64());
        assert!(output.status.success(), "{fault:?}: {said}");
        assert!(failed > 0, "{fault:?}: nothing was done to it");
    }
}

#[test]
fn a_bucket_does_what_a_store_must() {
    let Some(remote) = remote() else { return };
    RemoteStore::new(remote.clone()).probe(&AtomicBool::new(false)).expect("one that can be relied on");
    let own = format!("v1/test-{}", std::process::id());
    // Empty, small, larger than one part, exactly two parts.
    for size in [0, 5, (16 << 20) + 1, 32 << 20] {
        let bytes: Vec<u8> = (0..size).map(|i: usize| (i % 251) as u8).collect();
        let name = format!("{own}/{size}");
        assert_eq!(remote.size(&name).expect("an answer"), None);
        remote.put(&name, &mut &bytes[..], size as u64).expect("put");
        assert_eq!(remote.size(&name).expect("an answer"), Some(size as u64));
        assert!(read(remote.as_ref(), &name).is_some_and(|found| found == bytes), "{size}");
        // A source that fails during the upload leaves the old object.
        struct Fails(usize);
        impl Read for Fails {
            fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
                let n = self.0.min(buffer.len());
                self.0 -= n;
                if n == 0 { Err(io::Error::other("taken away")) } else { Ok(n) }
            }
        }
        let failed = remote.put(&name, &mut Fails(size), size as u64);
        assert!(matches!(failed, Err(RemoteError::Local(_))), "{size}: {failed:?}");
        assert!(read(remote.as_ref(), &name).is_some_and(|found| found == bytes), "{size}");
        remote.remove(&name).expect("removed");
        assert_eq!(read(remote.as_ref(), &name), None);
        remote.remove(&name).expect("nothing to remove is no error");
    }
    for round in 0..5 {
        let name = format!("{own}/race-{round}");
        let won: Mutex<Vec<Vec<u8>>> = Mutex::default();
        std::thread::scope(|scope| {
            for who in 0..8_u8 {
                let (won, name, remote) = (&won, &name, &remote);
                scope.spawn(move || {
                    if remote.create(name, &[who]).expect("an answer") {
                        won.lock().expect("lock").push(vec![who]);
                    }
                });
            }
        });
        let found = read(remote.as_ref(), &name).expect("created");
        assert_eq!(*won.lock().expect("lock"), [found]);
        remote.remove(&name).expect("removed");
    }
}
