//! A real S3 server, moto's, that checks the signatures of requests: `pip install 'moto[server]'`. Its
//! program is named in `USE3D_MOTO`.
#![allow(dead_code, reason = "every test program uses its own part of it")]

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// The number of unsigned requests that the server answers before it asks for signatures.
const OPEN: &str = "1000000000";

/// A server with one user; it ends with this value.
pub(crate) struct Moto {
    server: Child,
    address: String,
    key: String,
    secret: String,
}

impl Moto {
    /// The server that `USE3D_MOTO` asks for.
    pub(crate) fn asked() -> Option<Self> {
        let Some(program) = std::env::var_os("USE3D_MOTO") else {
            println!("SKIPPED, no bucket was used: set USE3D_MOTO to moto's program `moto_server`");
            return None;
        };
        let free = TcpListener::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).expect("a port");
        let mut server = Command::new(program);
        server.args(["-H", "127.0.0.1", "-p", &free.port().to_string()]);
        server.env("INITIAL_NO_AUTH_ACTION_COUNT", OPEN).stdout(Stdio::null()).stderr(Stdio::null());
        let server = server.spawn().expect("moto's server starts");
        let [key, secret] = [const { String::new() }; 2];
        let mut moto = Self { server, address: free.to_string(), key, secret };
        let start = Instant::now();
        while TcpStream::connect(&moto.address).is_err() {
            assert!(start.elapsed() < Duration::from_secs(60), "moto's server does not answer");
            std::thread::sleep(Duration::from_millis(50));
        }
        let all = r#"{"Version":"2012-10-17","Statement":[{"Effect":"Allow","Action":"*","Resource":"*"}]}"#;
        moto.users("CreateUser", "");
        moto.users("PutUserPolicy", &format!("&PolicyName=all&PolicyDocument={all}"));
        let made = moto.users("CreateAccessKey", "");
        (moto.key, moto.secret) = (between(&made, "AccessKeyId"), between(&made, "SecretAccessKey"));
        moto.lock(true);
        Some(moto)
    }

    /// Creates a bucket, and returns its address as a store.
    pub(crate) fn bucket(&self, name: &str) -> String {
        self.openly(|| self.request("PUT", &format!("/{name}"), "", b""));
        format!("s3://{name}/here")
    }

    /// The variables with which the server is reached.
    pub(crate) fn variables(&self) -> Vec<(&'static str, String)> {
        vec![
            ("AWS_ENDPOINT_URL", format!("http://{}", self.address)),
            ("AWS_ACCESS_KEY_ID", self.key.clone()),
            ("AWS_SECRET_ACCESS_KEY", self.secret.clone()),
            ("AWS_REGION", "us-east-1".to_string()),
        ]
    }

    /// The names of a bucket's objects.
    pub(crate) fn list(&self, bucket: &str, prefix: &str) -> Vec<String> {
        let path = format!("/{bucket}?list-type=2&prefix={prefix}");
        let answer = self.openly(|| self.request("GET", &path, "", b""));
        let text = String::from_utf8_lossy(&answer).into_owned();
        text.split("<Key>")
            .skip(1)
            .filter_map(|rest| Some(rest.split_once("</Key>")?.0.to_string()))
            .collect()
    }

    /// Changes an object, or removes it if there are no bytes.
    pub(crate) fn change(&self, bucket: &str, name: &str, change: impl Fn(Vec<u8>) -> Option<Vec<u8>>) {
        let path = format!("/{bucket}/{name}");
        let head = signed("s3");
        self.openly(|| match change(self.request("GET", &path, &head, b"")) {
            Some(bytes) => self.request("PUT", &path, &head, &bytes),
            None => self.request("DELETE", &path, &head, b""),
        });
    }

    /// Does something for which the server asks no signatures.
    fn openly<T>(&self, work: impl FnOnce() -> T) -> T {
        self.lock(false);
        let done = work();
        self.lock(true);
        done
    }

    fn lock(&self, locked: bool) {
        let count = if locked { "0" } else { OPEN };
        self.request("POST", "/moto-api/reset-auth", "Content-Type: text/plain\r\n", count.as_bytes());
    }

    /// An action of the service for users.
    fn users(&self, action: &str, more: &str) -> String {
        let body = format!("Action={action}&UserName=diver&Version=2010-05-08{more}");
        let head = format!("Content-Type: application/x-www-form-urlencoded\r\n{}", signed("iam"));
        String::from_utf8_lossy(&self.request("POST", "/", &head, body.as_bytes())).into_owned()
    }

    /// The body of the answer to a request, which has to succeed.
    fn request(&self, verb: &str, path: &str, head: &str, body: &[u8]) -> Vec<u8> {
        let mut stream = TcpStream::connect(&self.address).expect("connected");
        let (host, length) = (&self.address, body.len());
        let start = format!(
            "{verb} {path} HTTP/1.0\r\nHost: {host}\r\nConnection: close\r\nContent-Length: {length}\r\n{head}\r\n"
        );
        stream.write_all(&[start.as_bytes(), body].concat()).expect("sent");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).expect("an answer");
        let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").expect("a head");
        let head = String::from_utf8_lossy(&answer[..end]).into_owned();
        assert!(head.split_whitespace().nth(1).is_some_and(|code| code.starts_with('2')), "{path}: {head}");
        answer.split_off(end + 4)
    }
}

/// A signature for a service, which the server does not check while it is open.
fn signed(service: &str) -> String {
    let scope = format!("any/20260101/us-east-1/{service}/aws4_request");
    format!("Authorization: AWS4-HMAC-SHA256 Credential={scope}, SignedHeaders=host, Signature=0\r\n")
}

/// The text of an element.
fn between(text: &str, name: &str) -> String {
    let rest = text.split_once(&format!("<{name}>")).expect(name).1;
    rest.split_once('<').expect(name).0.to_string()
}

impl Drop for Moto {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}
