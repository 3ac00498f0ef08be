//! The part of HTTP/1.1 that a page on the same machine needs: requests with short heads and short bodies,
//! and answers with a known length.
//!
//! Heads are parsed by `httparse`. Everything is bounded: the length of a head and of a body, the number of
//! fields, and the time that a request may take.

use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

/// Most bytes of a request's head.
const HEAD: usize = 8 << 10;
/// Most fields of a head.
const FIELDS: usize = 64;
/// Most bytes of a request's body.
pub(crate) const BODY: usize = 64 << 10;
/// Longest time for receiving a request after its first byte, and for sending an answer.
const PATIENCE: Duration = Duration::from_secs(10);
/// Longest time that an open connection waits for its next request.
const IDLE: Duration = Duration::from_secs(30);

/// A request.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct HttpRequest {
    /// `GET`, `POST`, …
    pub(crate) method: String,
    /// The path with its query.
    pub(crate) path: String,
    pub(crate) host: Option<String>,
    pub(crate) origin: Option<String>,
    pub(crate) authorization: Option<String>,
    pub(crate) body: Vec<u8>,
    /// True if the connection stays open afterwards.
    pub(crate) stays: bool,
}

/// The reason why there is no request.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum NoRequest {
    /// The other side closed the connection, or was silent for too long.
    Gone,
    /// The request is refused: a status and a reason.
    Refused(u16, &'static str),
}

/// An answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Response {
    pub(crate) status: u16,
    pub(crate) kind: &'static str,
    /// Further header fields.
    pub(crate) fields: Vec<(&'static str, String)>,
    pub(crate) body: Vec<u8>,
}

impl Response {
    pub(crate) fn new(status: u16, kind: &'static str, body: impl Into<Vec<u8>>) -> Self {
        Self { status, kind, fields: Vec::new(), body: body.into() }
    }

    pub(crate) fn json(value: &serde_json::Value) -> Self {
        Self::new(200, "application/json", value.to_string())
    }

    pub(crate) fn text(status: u16, text: &str) -> Self {
        Self::new(status, "text/plain; charset=utf-8", text)
    }
}

const TOO_LONG: NoRequest = NoRequest::Refused(431, "the request's head is too long");

/// The end of a head, its request, and the length of the body.
fn head(bytes: &[u8]) -> Result<Option<(usize, HttpRequest, usize)>, NoRequest> {
    let mut fields = [httparse::EMPTY_HEADER; FIELDS];
    let mut parsed = httparse::Request::new(&mut fields);
    let end = match parsed.parse(bytes) {
        Ok(httparse::Status::Complete(end)) => end,
        Ok(httparse::Status::Partial) if bytes.len() < HEAD => return Ok(None),
        Ok(httparse::Status::Partial) | Err(httparse::Error::TooManyHeaders) => return Err(TOO_LONG),
        Err(_) => return Err(NoRequest::Refused(400, "this is not an HTTP request")),
    };
    if end > HEAD {
        return Err(TOO_LONG);
    }
    let field = |name: &str| -> Result<Option<String>, NoRequest> {
        let named = parsed.headers.iter().filter(|f| f.name.eq_ignore_ascii_case(name));
        let mut all = named.map(|f| String::from_utf8_lossy(f.value).trim().to_string());
        match (all.next(), all.next()) {
            (_, Some(_)) => Err(NoRequest::Refused(400, "a header field of the request occurs twice")),
            (first, None) => Ok(first),
        }
    };
    if field("transfer-encoding")?.is_some() {
        return Err(NoRequest::Refused(411, "the request needs a Content-Length"));
    }
    let length = match field("content-length")? {
        None => 0,
        Some(text) => text.parse().map_err(|_| NoRequest::Refused(400, "Content-Length is not a number"))?,
    };
    let request = HttpRequest {
        method: parsed.method.unwrap_or_default().to_string(),
        path: parsed.path.unwrap_or_default().to_string(),
        host: field("host")?,
        origin: field("origin")?,
        authorization: field("authorization")?,
        body: Vec::new(),
        stays: parsed.version == Some(1)
            && !field("connection")?.is_some_and(|v| v.eq_ignore_ascii_case("close")),
    };
    Ok(Some((end, request, length)))
}

/// Receives bytes, none if a signal interrupts it; `None` if nothing comes within `left`.
fn receive(stream: &mut TcpStream, left: Duration, block: &mut [u8]) -> Option<usize> {
    if left.is_zero() || stream.set_read_timeout(Some(left)).is_err() {
        return None;
    }
    match stream.read(block) {
        Ok(n) => (n > 0).then_some(n),
        Err(e) => (e.kind() == ErrorKind::Interrupted).then_some(0),
    }
}

/// Reads the next request of a connection. `bytes` are those that were received but not yet parsed.
pub(crate) fn read(stream: &mut TcpStream, bytes: &mut Vec<u8>) -> Result<HttpRequest, NoRequest> {
    let mut begun = (!bytes.is_empty()).then(Instant::now);
    let mut more = |bytes: &mut Vec<u8>| -> Result<(), NoRequest> {
        let left = begun.map_or(IDLE, |begun| PATIENCE.saturating_sub(begun.elapsed()));
        let mut block = [0; 4096];
        let n = receive(stream, left, &mut block).ok_or(NoRequest::Gone)?;
        if n > 0 {
            begun.get_or_insert_with(Instant::now);
        }
        bytes.extend_from_slice(&block[..n]);
        Ok(())
    };
    let (end, mut request, length) = loop {
        match head(bytes)? {
            Some(found) => break found,
            None => more(bytes)?,
        }
    };
    if length > BODY {
        return Err(NoRequest::Refused(413, "the request's body is too long"));
    }
    while bytes.len() < end + length {
        more(bytes)?;
    }
    request.body = bytes[end..end + length].to_vec();
    bytes.drain(..end + length);
    Ok(request)
}

fn reason(status: u16) -> &'static str {
    match status {
        200 => "OK",
        204 => "No Content",
        400 => "Bad Request",
        403 => "Forbidden",
        404 => "Not Found",
        405 => "Method Not Allowed",
        411 => "Length Required",
        413 => "Content Too Large",
        431 => "Request Header Fields Too Large",
        503 => "Service Unavailable",
        _ => "Internal Server Error",
    }
}

/// Sends an answer. It may not be cached, type-guessed, or shown inside another page.
pub(crate) fn write(stream: &mut TcpStream, response: &Response, stays: bool) -> std::io::Result<()> {
    stream.set_write_timeout(Some(PATIENCE))?;
    let mut head = format!(
        "HTTP/1.1 {} {}\r\nContent-Type: {}\r\nContent-Length: {}\r\nConnection: {}\r\nCache-Control: no-store\r\n\
         X-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\nCross-Origin-Resource-Policy: same-origin\r\n",
        response.status,
        reason(response.status),
        response.kind,
        response.body.len(),
        if stays { "keep-alive" } else { "close" },
    );
    for (name, value) in &response.fields {
        head.push_str(&format!("{name}: {value}\r\n"));
    }
    head.push_str("\r\n");
    stream.write_all(head.as_bytes())?;
    stream.write_all(&response.body)?;
    stream.flush()
}

/// Sends the last answer on a connection whose requests are not read to the end.
///
/// Unread data would make the system drop the answer together with the connection. So the data is read and
/// discarded for a limited time.
pub(crate) fn refuse(stream: &mut TcpStream, response: &Response) {
    if write(stream, response, false).is_err() || stream.shutdown(Shutdown::Write).is_err() {
        return;
    }
    let begun = Instant::now();
    while receive(stream, PATIENCE.saturating_sub(begun.elapsed()), &mut [0; 4096]).is_some() {}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_head_is_read_and_what_is_none_is_refused() {
        let text = b"POST /frame HTTP/1.1\r\nHost: localhost:7007\r\nOrigin: http://localhost:7007\r\nContent-Length: 2\r\n\r\n{}";
        let (end, request, length) = head(text).unwrap().unwrap();
        assert_eq!(
            (&text[end..], length, request.path.as_str(), request.stays),
            (&b"{}"[..], 2, "/frame", true)
        );
        assert_eq!(head(&text[..40]), Ok(None));
        let refused = |text: &str| match head(text.as_bytes()) {
            Err(NoRequest::Refused(status, _)) => status,
            other => panic!("{other:?}"),
        };
        assert_eq!(refused("\u{1}\u{2}\r\n\r\n"), 400);
        assert_eq!(refused("GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n"), 400);
        assert_eq!(refused("POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n"), 411);
        assert_eq!(refused("POST / HTTP/1.1\r\nContent-Length: -1\r\n\r\n"), 400);
        assert_eq!(refused(&format!("GET /{} HTTP/1.1\r\n", "a".repeat(HEAD))), 431);
        assert_eq!(refused(&format!("GET / HTTP/1.1\r\n{}\r\n", "A: b\r\n".repeat(FIELDS + 1))), 431);
    }
}
