//! Tests `run --remote`, `push`, `pull` and `store` with a bucket of a real S3 server, which checks
//! signatures. The server is moto's, and its program is named in `USE3D_MOTO`:
//!
//! ```text
//! pip install 'moto[server]'
//! USE3D_MOTO=moto_server cargo test --workspace --features use3d/s3 --test bucket -- --nocapture
//! ```
#![cfg(feature = "s3")]

mod many;
mod moto;
mod tiny;

use std::process::{Command, Stdio};

use many::Many;
use moto::Moto;

/// Exit code and output.
fn ended(mut command: Command) -> (Option<i32>, String) {
    let output = command.output().expect("the command starts");
    let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    (output.status.code(), said.concat())
}

/// Two captures and a server.
struct Lab {
    many: Many,
    moto: Moto,
}

impl Lab {
    fn asked() -> Option<Self> {
        let moto = Moto::asked()?;
        Some(Self { many: Many::new(&["s1", "s2"].map(String::from)), moto })
    }

    /// A verb with a cache and a store, and the server's variables.
    fn command(&self, verb: &str, cache: &str, store: &str, words: &[&str]) -> Command {
        let mut command = self.many.command(&[verb], cache);
        command.args(["--remote", store]).args(words).envs(self.moto.variables());
        command
    }

    fn done(&self, verb: &str, cache: &str, store: &str, words: &[&str]) -> String {
        let (code, said) = ended(self.command(verb, cache, store, words));
        assert_eq!(code, Some(0), "{verb} {words:?}: {said}");
        said
    }
}

#[test]
fn what_one_machine_computed_is_in_the_bucket_for_others() {
    let Some(lab) = Lab::asked() else { return };
    let (store, other) = (lab.moto.bucket("lab"), lab.moto.bucket("other"));
    lab.done("run", "first", &store, &["--cache-only"]);
    let whole = lab.many.artifacts("first");
    let said = lab.done("pull", "second", &store, &["--all-or-fail"]);
    assert!(lab.many.artifacts("second") == whole, "{said}");
    let said = lab.done("run", "third", &store, &["--out", "out-third"]);
    assert!(said.contains(" 0 stages done,") && lab.many.artifacts("third") == whole, "{said}");
    assert_eq!(lab.many.scores("out-third".as_ref()).len(), 2);
    // From a cache into another bucket, and once more.
    lab.done("push", "second", &other, &["--all-or-fail"]);
    lab.done("pull", "fourth", &other, &["--all-or-fail"]);
    assert!(lab.many.artifacts("fourth") == whole);
    let said = lab.done("push", "second", &other, &["--check"]);
    assert!(said.contains("0 artifacts (0 B) moved"), "{said}");
    let mut list = tiny::command();
    list.args(["store", "ls", "--remote", &store]).envs(lab.moto.variables());
    let (code, said) = ended(list);
    assert!(code == Some(0) && said.contains("evaluate     2\n"), "{said}");
    let claims = lab.moto.list("lab", "here/v1/claims/");
    assert!(claims.is_empty(), "{claims:?}");
}

#[test]
fn two_machines_that_share_only_the_bucket_compute_nothing_twice() {
    let Some(lab) = Lab::asked() else { return };
    let store = lab.moto.bucket("lab");
    let words = ["--cache-only", "--json", "--threads", "1"];
    let machines = ["east", "west"].map(|cache| {
        let mut command = lab.command("run", cache, &store, &words);
        command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the command starts")
    });
    let computed = machines.map(|machine| {
        let output = machine.wait_with_output().expect("it ends");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        summary["nodes"].as_array().expect("nodes").iter().filter(|n| n["result"] == "done").count()
    });
    println!("{computed:?} stages by two machines");
    let all = std::fs::read_dir(lab.many.at("east/v1/artifacts")).expect("stages").flatten();
    let all: usize = all.map(|stage| std::fs::read_dir(stage.path()).expect("keys").count()).sum();
    assert_eq!(computed.iter().sum::<usize>(), all, "{computed:?}");
    assert!(lab.many.artifacts("east") == lab.many.artifacts("west"));
}

#[test]
fn damaged_objects_are_noticed_computed_and_replaced() {
    let Some(lab) = Lab::asked() else { return };
    let store = lab.moto.bucket("lab");
    lab.done("run", "first", &store, &["--cache-only"]);
    let whole = lab.many.artifacts("first");
    let names = |part: &str| lab.moto.list("lab", &format!("here/v1/{part}"));
    let (blobs, scores) = (names("blobs/"), names("artifacts/evaluate/"));
    lab.moto.change("lab", &blobs[0], |mut bytes| {
        bytes[0] ^= 1;
        Some(bytes)
    });
    lab.moto.change("lab", &blobs[1], |bytes| Some(bytes[..bytes.len() / 2].to_vec()));
    lab.moto.change("lab", &blobs[2], |_| None);
    lab.moto.change("lab", &scores[0], |bytes| Some(bytes[..bytes.len() / 2].to_vec()));
    let (code, said) = ended(lab.command("pull", "second", &store, &["--quiet"]));
    for word in ["has other bytes than its digest", "push --check"] {
        assert!(code == Some(1) && said.contains(word), "{word}: {said}");
    }
    let fetched = lab.many.artifacts("second");
    assert!(fetched.iter().all(|(path, bytes)| whole.get(path) == Some(bytes)));
    let said = lab.done("run", "second", &store, &["--cache-only"]);
    assert!(lab.many.artifacts("second") == whole && said.contains("computing it"), "{said}");
    lab.done("push", "first", &store, &["--check"]);
    lab.done("pull", "third", &store, &["--all-or-fail"]);
    assert!(lab.many.artifacts("third") == whole);
}

#[test]
fn wrong_keys_and_a_missing_bucket_are_said_in_words() {
    let Some(lab) = Lab::asked() else { return };
    let store = lab.moto.bucket("lab");
    for (store, secret, words) in [
        (store.as_str(), "wrong", ["s3://lab/here", "AWS_SECRET_ACCESS_KEY"]),
        ("s3://nowhere/here", "", ["s3://nowhere/here", "there is no such"]),
    ] {
        for verb in ["run", "push", "pull", "store"] {
            let mut command = match verb {
                "store" => {
                    let mut list = tiny::command();
                    list.args(["store", "ls", "--remote", store]).envs(lab.moto.variables());
                    list
                }
                verb => lab.command(verb, "cache", store, &[]),
            };
            if !secret.is_empty() {
                command.env("AWS_SECRET_ACCESS_KEY", secret);
            }
            let (code, said) = ended(command);
            println!("{verb}: {said}");
            assert!(code == Some(1) && words.iter().all(|word| said.contains(word)), "{verb}: {said}");
            assert!(!said.contains("<?xml") && !said.contains("<Error>"), "{verb}: {said}");
        }
    }
    assert!(lab.many.artifacts("cache").is_empty(), "nothing was computed");
}
