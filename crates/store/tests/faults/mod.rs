//! A proxy between a client and a real server, which fails in one of the ways in which servers fail.
//!
//! Most failures are temporary: the first request of a kind for a name fails, or the first two, and the next
//! one is answered. Two are permanent: such a server never gives a usable answer, and the client has to work
//! without it.

use std::collections::HashMap;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Longer than a client waits for the next bytes.
const STALL: Duration = Duration::from_secs(65);

/// A fault of the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Fault {
    /// The answer is 503.
    Busy,
    /// The operation is performed, and the answer is 500.
    Lost,
    /// The operation is performed, and the connection ends without an answer.
    Dropped,
    /// The second half of an object is not sent.
    Truncated,
    /// A byte of an object is changed.
    Wrong,
    /// An object is sent in pieces with pauses between them.
    Slow,
    /// An object's second half is not sent for longer than any client waits.
    Stalled,
    /// The answer is always 503.
    Gone,
    /// A byte of every requested object is changed.
    Liar,
}

impl Fault {
    pub(crate) const ALL: [Self; 9] = [
        Self::Busy,
        Self::Lost,
        Self::Dropped,
        Self::Truncated,
        Self::Wrong,
        Self::Slow,
        Self::Stalled,
        Self::Gone,
        Self::Liar,
    ];

    /// Returns true if the fault is permanent.
    pub(crate) fn is_lasting(self) -> bool {
        matches!(self, Self::Gone | Self::Liar)
    }

    /// Returns true if the fault applies to a request after `before` earlier ones.
    fn befalls(self, method: &str, before: usize) -> bool {
        let reads = method == "GET";
        match self {
            Self::Busy => before < 2,
            // Only the first request fails: the next one finds the effect of the first.
            Self::Lost | Self::Dropped => before < 1,
            Self::Truncated | Self::Wrong => reads && before < 2,
            Self::Stalled => reads && before < 1,
            Self::Slow | Self::Liar => reads,
            Self::Gone => true,
        }
    }
}

struct Shared {
    upstream: String,
    fault: Fault,
    requests: AtomicUsize,
    failed: AtomicUsize,
    seen: Mutex<HashMap<String, usize>>,
}

/// The proxy. It ends with the process.
pub(crate) struct Proxy {
    address: String,
    shared: Arc<Shared>,
}

impl Proxy {
    /// Starts the proxy for a server at an address such as `http://127.0.0.1:5555`.
    pub(crate) fn start(upstream: &str, fault: Fault) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = format!("http://{}", listener.local_addr().expect("an address"));
        let upstream =
            upstream.strip_prefix("http://").expect("a server without TLS").trim_end_matches('/').to_string();
        let (requests, failed) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let shared = Arc::new(Shared { upstream, fault, requests, failed, seen: Mutex::default() });
        let own = shared.clone();
        std::thread::spawn(move || {
            for client in listener.incoming().flatten() {
                let own = own.clone();
                // A client that disconnects does no harm.
                std::thread::spawn(move || own.serve(client).ok());
            }
        });
        Self { address, shared }
    }

    pub(crate) fn address(&self) -> &str {
        &self.address
    }

    /// Number of requests, and number of requests with a fault.
    pub(crate) fn counts(&self) -> (usize, usize) {
        (self.shared.requests.load(Ordering::Relaxed), self.shared.failed.load(Ordering::Relaxed))
    }
}

/// The lines before a message's body, and the length of the body.
fn head(from: &mut impl BufRead) -> io::Result<(Vec<String>, usize)> {
    let (mut lines, mut length) = (Vec::new(), 0);
    loop {
        let mut line = String::new();
        if from.read_line(&mut line)? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let line = line.trim_end();
        if line.is_empty() {
            return Ok((lines, length));
        }
        if let Some((name, value)) = line.split_once(':') {
            if name.eq_ignore_ascii_case("content-length") {
                length = value.trim().parse().map_err(io::Error::other)?;
            }
            // One request per connection.
            if name.eq_ignore_ascii_case("connection") {
                continue;
            }
        }
        lines.push(line.to_string());
    }
}

fn join(lines: &[String]) -> String {
    lines.join("\r\n") + "\r\nconnection: close\r\n\r\n"
}

impl Shared {
    fn serve(&self, mut client: TcpStream) -> io::Result<()> {
        let mut from = BufReader::new(client.try_clone()?);
        let (lines, length) = head(&mut from)?;
        let mut body = vec![0; length];
        from.read_exact(&mut body)?;
        let request = lines.first().cloned().unwrap_or_default();
        let method = request.split(' ').next().unwrap_or_default();
        self.requests.fetch_add(1, Ordering::Relaxed);
        let before = {
            let mut seen = self.seen.lock().expect("lock");
            // A probe has another name at every attempt.
            let kind = request.split_once("/probe/").map_or(request.as_str(), |(before, _)| before);
            let count = seen.entry(kind.to_string()).or_default();
            *count += 1;
            *count - 1
        };
        let fault = Some(self.fault).filter(|fault| fault.befalls(method, before));
        let failed =
            |status: &str| format!("HTTP/1.1 {status}\r\ncontent-length: 0\r\nconnection: close\r\n\r\n");
        if matches!(fault, Some(Fault::Busy | Fault::Gone)) {
            self.failed.fetch_add(1, Ordering::Relaxed);
            return client.write_all(failed("503 Slow Down").as_bytes());
        }
        let mut server = TcpStream::connect(&self.upstream)?;
        server.write_all(join(&lines).as_bytes())?;
        server.write_all(&body)?;
        let mut answer = BufReader::new(server);
        let (lines, _) = head(&mut answer)?;
        let mut found = Vec::new();
        answer.read_to_end(&mut found)?;
        let is_read =
            lines.first().is_some_and(|line| line.contains(" 20")) && method == "GET" && !found.is_empty();
        let Some(fault) = fault.filter(|fault| is_read || matches!(fault, Fault::Lost | Fault::Dropped))
        else {
            client.write_all(join(&lines).as_bytes())?;
            return client.write_all(&found);
        };
        self.failed.fetch_add(1, Ordering::Relaxed);
        let half = found.len() / 2;
        match fault {
            Fault::Lost => return client.write_all(failed("500 Internal Server Error").as_bytes()),
            Fault::Dropped => return Ok(()),
            Fault::Wrong | Fault::Liar => found[half] ^= 1,
            _ => {}
        }
        client.write_all(join(&lines).as_bytes())?;
        match fault {
            Fault::Truncated => client.write_all(&found[..half]),
            Fault::Stalled => {
                client.write_all(&found[..half])?;
                std::thread::sleep(STALL);
                client.write_all(&found[half..])
            }
            Fault::Slow => found.chunks(found.len().div_ceil(20)).try_for_each(|piece| {
                std::thread::sleep(Duration::from_millis(50));
                client.write_all(piece)
            }),
            _ => client.write_all(&found),
        }
    }
}
