//! A real Chromium, controlled over its DevTools protocol through a pair of pipes: no port, no WebSocket, no
//! further crate.
//!
//! With `--remote-debugging-pipe` Chromium reads commands from file descriptor 3 and writes answers and
//! events to 4, each as a JSON text that ends with a zero byte. A shell connects its standard input and
//! output to these two.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde_json::{Value, json};

/// The browser and one page in it.
pub(crate) struct Chromium {
    child: Child,
    commands: ChildStdin,
    answers: BufReader<ChildStdout>,
    session: String,
    next: u64,
    /// The errors that the page wrote to its console, and exceptions that were not caught.
    pub(crate) complaints: Vec<String>,
    _profile: tempfile::TempDir,
}

/// The browser's program: `USE3D_CHROMIUM`, or the first of the usual names.
fn program() -> Option<String> {
    if let Ok(named) = std::env::var("USE3D_CHROMIUM") {
        return Some(named);
    }
    let known = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];
    let runs = |name: &&str| {
        let version =
            Command::new(name).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
        version.is_ok_and(|status| status.success())
    };
    known.into_iter().find(runs).map(str::to_string)
}

impl Chromium {
    /// Starts it with an empty page; `None`, with a printed reason, if there is no Chromium. With `CI=1` that
    /// is a failure.
    pub(crate) fn start() -> Option<Self> {
        let Some(program) = program() else {
            assert!(
                std::env::var("CI").as_deref() != Ok("1"),
                "no Chromium: install `chromium`, or name one by USE3D_CHROMIUM"
            );
            eprintln!("SKIPPED: no Chromium found; install `chromium`, or name one by USE3D_CHROMIUM");
            return None;
        };
        let profile = tempfile::tempdir().expect("a folder");
        // Chromium has its own software renderer; a driver that was chosen for other programs draws slightly
        // differently.
        let mut child = Command::new("sh")
            .env_remove("VK_DRIVER_FILES")
            .env_remove("VK_ICD_FILENAMES")
            .args(["-c", "exec \"$0\" \"$@\" 3<&0 4>&1 </dev/null >/dev/null", &program])
            .args(["--headless=new", "--remote-debugging-pipe", "--no-sandbox", "--disable-gpu-watchdog"])
            // Drawing in software is the same on every machine; the network is off except for this machine.
            .args([
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
            ])
            .args([
                "--no-first-run",
                "--disable-extensions",
                "--disable-background-networking",
                "--disable-dev-shm-usage",
            ])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg("about:blank")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("the shell starts");
        let commands = child.stdin.take().expect("a pipe");
        let answers = BufReader::new(child.stdout.take().expect("a pipe"));
        let mut browser = Self {
            child,
            commands,
            answers,
            session: String::new(),
            next: 0,
            complaints: Vec::new(),
            _profile: profile,
        };
        let target = browser.ask("Target.createTarget", json!({ "url": "about:blank" }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        let attached = browser.ask("Target.attachToTarget", attach);
        browser.session = attached["sessionId"].as_str().expect("a session").to_string();
        for domain in ["Page", "Runtime", "Log", "Accessibility"] {
            browser.ask(&format!("{domain}.enable"), json!({}));
        }
        Some(browser)
    }

    /// Sends a command and waits for its answer; complaints in the events that arrive meanwhile are stored.
    pub(crate) fn ask(&mut self, method: &str, parameters: Value) -> Value {
        self.next += 1;
        let id = self.next;
        let mut message = json!({ "id": id, "method": method });
        message["params"] = parameters;
        if !self.session.is_empty() {
            message["sessionId"] = self.session.as_str().into();
        }
        let mut text = message.to_string().into_bytes();
        text.push(0);
        self.commands.write_all(&text).expect("Chromium listens");
        self.commands.flush().expect("Chromium listens");
        loop {
            let mut bytes = Vec::new();
            self.answers.read_until(0, &mut bytes).expect("Chromium answers");
            assert_eq!(bytes.pop(), Some(0), "Chromium ended during {method}");
            let answer: Value = serde_json::from_slice(&bytes).expect("JSON");
            if answer["id"] == id {
                assert!(answer["error"].is_null(), "{method}: {}", answer["error"]);
                return answer["result"].clone();
            }
            self.note(&answer);
        }
    }

    fn note(&mut self, event: &Value) {
        let parameters = &event["params"];
        match event["method"].as_str() {
            Some("Runtime.exceptionThrown") => {
                self.complaints.push(parameters["exceptionDetails"].to_string());
            }
            Some("Runtime.consoleAPICalled")
                if parameters["type"] == "error" || parameters["type"] == "warning" =>
            {
                self.complaints.push(parameters["args"].to_string());
            }
            Some("Log.entryAdded") if parameters["entry"]["level"] == "error" => {
                self.complaints.push(parameters["entry"].to_string());
            }
            _ => {}
        }
    }

    /// The value of an expression; for a promise, its value when it is fulfilled.
    pub(crate) fn evaluate(&mut self, expression: &str) -> Value {
        let parameters = json!({ "expression": expression, "awaitPromise": true, "returnByValue": true, "userGesture": true });
        let answer = self.ask("Runtime.evaluate", parameters);
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {}", answer["exceptionDetails"]);
        answer["result"]["value"].clone()
    }

    /// Waits until an expression is true, because input reaches the page with a delay.
    pub(crate) fn until(&mut self, expression: &str) {
        let kept = self.evaluate(&format!(
            "new Promise(done => {{ const ends = Date.now() + 20000; const look = () => (({expression}) ? done(true) : Date.now() > ends ? done(false) : setTimeout(look, 10)); look(); }})"
        ));
        assert_eq!(kept, true, "waited in vain for {expression}");
    }

    /// Opens an address.
    pub(crate) fn go(&mut self, address: &str) {
        self.ask("Page.navigate", json!({ "url": address }));
    }

    /// Opens a file and waits until the scene is shown. The page draws by WebGL, as with a graphics card.
    pub(crate) fn open(&mut self, path: &std::path::Path) {
        self.go(&format!("file://{}#webgl", path.display()));
        self.ready();
        self.evaluate("use3d.settled()");
    }

    /// Waits until the scene is shown.
    pub(crate) fn ready(&mut self) {
        self.evaluate(
            "new Promise(done => { const look = () => (window.use3d ? use3d.ready.then(() => done(true), e => done(String(e))) : setTimeout(look, 20)); look(); })",
        );
    }

    /// Sets the size of the window in CSS pixels, and the emulation of a phone.
    pub(crate) fn resize(&mut self, width: u32, height: u32, phone: bool) {
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone });
        self.ask("Emulation.setDeviceMetricsOverride", metrics);
        self.ask("Emulation.setTouchEmulationEnabled", json!({ "enabled": phone }));
    }

    /// Sets the light or dark scheme, as the system would.
    pub(crate) fn scheme(&mut self, scheme: &str) {
        let feature = json!({ "features": [{ "name": "prefers-color-scheme", "value": scheme }, { "name": "prefers-reduced-motion", "value": "reduce" }] });
        self.ask("Emulation.setEmulatedMedia", feature);
    }

    /// Cuts the page off from every address, or lets it reach them again.
    pub(crate) fn offline(&mut self, offline: bool) {
        self.ask("Network.enable", json!({}));
        let conditions =
            json!({ "offline": offline, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1 });
        self.ask("Network.emulateNetworkConditions", conditions);
    }

    /// Presses and releases a key.
    pub(crate) fn key(&mut self, key: &str, code: &str) {
        for kind in ["keyDown", "keyUp"] {
            let text = if kind == "keyDown" && key.len() == 1 { key } else { "" };
            self.ask(
                "Input.dispatchKeyEvent",
                json!({ "type": kind, "key": key, "code": code, "text": text }),
            );
        }
    }

    /// Drags with the left button.
    pub(crate) fn drag(&mut self, from: [f64; 2], to: [f64; 2]) {
        let mouse = |kind: &str, at: [f64; 2], buttons: u32| {
            let button = if buttons == 0 && kind == "mouseMoved" { "none" } else { "left" };
            json!({ "type": kind, "x": at[0], "y": at[1], "button": button, "buttons": buttons, "clickCount": 1 })
        };
        self.ask("Input.dispatchMouseEvent", mouse("mouseMoved", from, 0));
        self.ask("Input.dispatchMouseEvent", mouse("mousePressed", from, 1));
        for step in 1..=5 {
            let at = std::array::from_fn(|i| from[i] + (to[i] - from[i]) * f64::from(step) / 5.0);
            self.ask("Input.dispatchMouseEvent", mouse("mouseMoved", at, 1));
        }
        self.ask("Input.dispatchMouseEvent", mouse("mouseReleased", to, 0));
    }

    /// Moves fingers: for each finger the start and the end.
    pub(crate) fn touch(&mut self, fingers: &[([f64; 2], [f64; 2])]) {
        let points = |share: f64| -> Vec<Value> {
            let at = |a: f64, b: f64| a + share * (b - a);
            let finger = |(id, (from, to)): (usize, &([f64; 2], [f64; 2]))| json!({ "x": at(from[0], to[0]), "y": at(from[1], to[1]), "id": id });
            fingers.iter().enumerate().map(finger).collect()
        };
        self.ask("Input.dispatchTouchEvent", json!({ "type": "touchStart", "touchPoints": points(0.0) }));
        for step in 1..=5 {
            let moved = points(f64::from(step) / 5.0);
            self.ask("Input.dispatchTouchEvent", json!({ "type": "touchMove", "touchPoints": moved }));
        }
        self.ask("Input.dispatchTouchEvent", json!({ "type": "touchEnd", "touchPoints": [] }));
    }
}

impl Drop for Chromium {
    fn drop(&mut self) {
        // The shell was replaced by the browser, so this process is the browser.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
