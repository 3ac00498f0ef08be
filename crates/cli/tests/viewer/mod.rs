//! A client for the viewer of a running command, which sends the requests of a browser's page.
#![allow(dead_code, reason = "every test program uses its own part of it")]

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::Child;

use serde_json::{Value, json};

/// A viewer of a running command.
pub(crate) struct Viewer {
    pub(crate) port: u16,
    token: String,
}

impl Viewer {
    /// The viewer whose address a command prints on its standard output or error.
    pub(crate) fn of(printed: impl Read + Send + 'static) -> Self {
        let mut lines = BufReader::new(printed).lines().map_while(Result::ok);
        let address = lines.find(|line| line.starts_with("http://")).expect("an address");
        // The rest of the output is read too, so that it cannot fill the pipe.
        std::thread::spawn(move || lines.for_each(drop));
        let (place, token) = address.split_once("/#").expect("a token");
        let port = place.rsplit_once(':').expect("a port").1.parse().expect("a number");
        Self { port, token: token.into() }
    }

    /// Sends a request and returns the stream with the unread answer; `None` after the command has ended.
    pub(crate) fn send(&self, path: &str, body: &Value) -> Option<TcpStream> {
        let (body, host) = (body.to_string(), format!("127.0.0.1:{}", self.port));
        let mut stream = TcpStream::connect(&host).ok()?;
        let head = format!(
            "POST {path} HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nAuthorization: Bearer {}\r\nConnection: close\r\nContent-Length: {}\r\n\r\n",
            self.token,
            body.len()
        );
        stream.write_all((head + &body).as_bytes()).ok()?;
        Some(stream)
    }

    /// Sends a request and returns status and body of the answer; `None` after the command has ended.
    pub(crate) fn ask(&self, path: &str, body: &Value) -> Option<(u16, Vec<u8>)> {
        let mut stream = self.send(path, body)?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).ok()?;
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n")? + 4;
        let status = String::from_utf8_lossy(answer.get(9..12)?).parse().ok()?;
        Some((status, answer[end..].to_vec()))
    }

    pub(crate) fn json(&self, path: &str, body: &Value) -> Option<Value> {
        self.ask(path, body).and_then(|(_, text)| serde_json::from_slice(&text).ok())
    }

    pub(crate) fn command(&self, name: &str) -> Option<Value> {
        self.json("/do", &json!({ "name": name }))
    }

    /// The header of the scene, after waiting until there is one.
    pub(crate) fn header(&self) -> Value {
        loop {
            let beginning = self.json("/scene", &json!({})).expect("an answer");
            if beginning["waiting"].is_null() {
                return beginning["header"].clone();
            }
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
    }

    /// Draws the `i`th view, moved by `i`, in one mode after the other; returns the status.
    pub(crate) fn draw(&self, header: &Value, i: usize) -> Option<u16> {
        let view = &header["cameras"][i % header["cameras"].as_array().map_or(1, Vec::len)];
        let eye: Vec<f64> =
            (0..3).map(|k| view["eye"][k].as_f64().unwrap_or(0.0) + 0.01 * i as f64).collect();
        let mode = ["reconstruction", "clear", "medium", "depth"][i % 4];
        let look = json!({
            "page": "test", "mode": mode, "left": if i.is_multiple_of(3) { json!("clear") } else { Value::Null }, "at": 0.3, "strength": 1,
            "water": (i % 5) as f64 / 4.0, "moving": i.is_multiple_of(2),
            "camera": { "eye": eye, "rotation": view["rotation"], "lens": view["lens"], "width": view["width"], "height": view["height"] },
        });
        self.ask("/frame", &look).map(|(status, _)| status)
    }
}

/// Ends a command that would run for ever, when it is dropped.
pub(crate) struct Ended(pub(crate) Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
