//! The server's answers to requests as a browser, a foreign page and a broken program would send them.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::{Value, json};
use use3d_capture::Frame;
use use3d_medium::{MediumModel, MediumRbf};
use use3d_scene::Scene;
use use3d_splat::Gaussians;
use use3d_viewer::{Live, Server, ServerError, Shown};

fn scene() -> Arc<Scene> {
    let gaussians = Gaussians {
        sh_degree: 0,
        means: vec![[0.0, 0.0, 2.0], [0.4, 0.1, 3.0]],
        log_scales: vec![[-1.5; 3]; 2],
        quaternions: vec![[1.0, 0.0, 0.0, 0.0]; 2],
        opacity_logits: vec![2.0; 2],
        sh: vec![[[0.5, 0.2, -0.3]; 16]; 2],
    };
    let medium = MediumModel::Rbf(MediumRbf::new(8, 4));
    Arc::new(Scene { gaussians, frame: Frame::IDENTITY, medium, medium_degree: 3, enhancement: None })
}

fn shown() -> Shown {
    Shown {
        name: "reef".into(),
        scene: scene(),
        views: Arc::default(),
        metres_per_unit: None,
        saved: None,
        white: None,
        step: None,
        points: false,
    }
}

/// Sends bytes and reads the whole answer: status, head, body.
fn send(port: u16, bytes: &[u8]) -> (u16, String, Vec<u8>) {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    // After a refusal the server reads no more.
    let _ = stream.write_all(bytes);
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.windows(4).position(|w| w == b"\r\n\r\n").expect("a head") + 4;
    let head = String::from_utf8_lossy(&answer[..end]).into_owned();
    (head[9..12].parse().unwrap(), head, answer[end..].to_vec())
}

fn post(port: u16, path: &str, fields: &[(&str, &str)], body: &[u8]) -> (u16, String, Vec<u8>) {
    let mut text = format!("POST {path} HTTP/1.1\r\nConnection: close\r\nContent-Length: {}\r\n", body.len());
    fields.iter().for_each(|(name, value)| text.push_str(&format!("{name}: {value}\r\n")));
    send(port, &[text.as_bytes(), b"\r\n", body].concat())
}

/// A request as the server's own page sends it.
fn ask(server: &Server, path: &str, body: &Value) -> (u16, String, Vec<u8>) {
    let (host, bearer) = (format!("localhost:{}", server.port()), format!("Bearer {}", token(server)));
    let fields = [("Host", host.as_str()), ("Origin", &format!("http://{host}")), ("Authorization", &bearer)];
    post(server.port(), path, &fields, body.to_string().as_bytes())
}

fn token(server: &Server) -> String {
    server.address().split_once('#').expect("a token").1.to_string()
}

fn look(width: usize, mode: &str) -> Value {
    json!({ "page": "a", "camera": { "eye": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "lens": [40, 40, 32, 24], "width": width, "height": 48 },
        "mode": mode, "left": null, "at": 0.5, "strength": 1, "water": 1, "moving": false })
}

#[test]
fn only_this_machine_s_own_page_with_the_token_is_answered() {
    let live = Arc::new(Live::new("nothing yet", None));
    let server = Server::start(None, &live).unwrap();
    let (port, bearer) = (server.port(), format!("Bearer {}", token(&server)));
    let (own, origin) = (format!("127.0.0.1:{port}"), format!("http://127.0.0.1:{port}"));
    let state = |host: &str, origin: Option<&str>, authorization: Option<&str>| {
        let mut fields = vec![("Host", host)];
        fields.extend(origin.map(|o| ("Origin", o)));
        fields.extend(authorization.map(|a| ("Authorization", a)));
        post(port, "/state", &fields, b"{}").0
    };
    assert_eq!(state(&own, Some(&origin), Some(&bearer)), 200);
    // Through a tunnel the port is another one.
    assert_eq!(state("localhost:9000", Some("http://localhost:9000"), Some(&bearer)), 200);
    for host in
        ["reef.example", "127.0.0.1.reef.example:80", "localhost.reef.example", "192.168.1.4", "[fe80::1]"]
    {
        assert_eq!(state(host, Some(&format!("http://{host}")), Some(&bearer)), 403, "{host}");
    }
    for foreign in [Some("http://reef.example"), Some("null"), Some("http://localhost:1"), None] {
        assert_eq!(state(&own, foreign, Some(&bearer)), 403, "{foreign:?}");
    }
    let short = &bearer[..bearer.len() - 1];
    for wrong in [
        None,
        Some("Bearer "),
        Some(short),
        Some("Basic abc"),
        Some("Bearer 00000000000000000000000000000000"),
    ] {
        assert_eq!(state(&own, Some(&origin), wrong), 403, "{wrong:?}");
    }
    // The page itself contains no secret, may not be framed, and can connect only to its own server.
    let (status, head, page) =
        send(port, format!("GET / HTTP/1.1\r\nHost: {own}\r\nConnection: close\r\n\r\n").as_bytes());
    assert!(
        status == 200 && head.contains("frame-ancestors 'none'") && head.contains("connect-src 'self'"),
        "{head}"
    );
    assert!(
        head.contains("nosniff")
            && !head.contains("Access-Control")
            && !String::from_utf8_lossy(&page).contains(&token(&server))
    );
    assert_eq!(send(port, b"GET / HTTP/1.1\r\nHost: reef.example\r\nConnection: close\r\n\r\n").0, 403);
    assert_eq!(
        send(
            port,
            format!("GET /../etc/passwd HTTP/1.1\r\nHost: {own}\r\nConnection: close\r\n\r\n").as_bytes()
        )
        .0,
        404
    );
    assert_eq!(
        send(port, format!("PUT / HTTP/1.1\r\nHost: {own}\r\nConnection: close\r\n\r\n").as_bytes()).0,
        405
    );
}

#[test]
fn what_is_too_long_or_senseless_is_refused() {
    let live = Arc::new(Live::new("nothing yet", None));
    let server = Server::start(None, &live).unwrap();
    let long = json!({ "page": "a".repeat(70_000) });
    assert_eq!(ask(&server, "/frame", &long).0, 413);
    assert_eq!(
        send(
            server.port(),
            format!("GET / HTTP/1.1\r\nHost: localhost\r\nA: {}\r\n\r\n", "b".repeat(9000)).as_bytes()
        )
        .0,
        431
    );
    assert_eq!(send(server.port(), b"\x16\x03\x01\x02 hello\r\n\r\n").0, 400);
    let said = |body: &Value| {
        let (status, _, text) = ask(&server, "/frame", body);
        (status, String::from_utf8_lossy(&text).into_owned())
    };
    assert_eq!(said(&look(100_000, "clear")).0, 400);
    assert!(said(&look(64, "sunny")).1.contains("sunny"));
    assert!(said(&json!({ "page": 3 })).1.contains("cannot be read"));
    let mut bent = look(64, "clear");
    bent["camera"]["rotation"] = json!([[2, 0, 0], [0, 1, 0], [0, 0, 1]]);
    assert!(said(&bent).1.contains("orthonormal"));
    // There is no scene, and nothing to stop.
    assert_eq!(said(&look(64, "clear")).0, 503);
    assert_eq!(ask(&server, "/do", &json!({ "name": "stop" })).0, 400);
    assert_eq!(ask(&server, "/elsewhere", &json!({})).0, 404);
    let (_, _, waiting) = ask(&server, "/scene", &json!({}));
    assert_eq!(serde_json::from_slice::<Value>(&waiting).unwrap(), json!({ "waiting": "nothing yet" }));
}

#[test]
fn a_scene_is_drawn_handed_over_and_its_training_stopped() {
    let stop = Arc::new(AtomicBool::new(false));
    let live = Arc::new(Live::new("", Some(stop.clone())));
    let server = Server::start(None, &live).unwrap();
    live.show(shown());
    let (status, head, png) = ask(&server, "/frame", &look(64, "reconstruction"));
    assert!(status == 200 && head.contains("image/png") && head.contains("X-Divisor: 1"), "{head}");
    assert_eq!([&png[16..20], &png[20..24]].map(|b| u32::from_be_bytes(b.try_into().unwrap())), [64, 48]);
    let mut moving = look(64, "depth");
    (moving["moving"], moving["left"]) = (json!(true), json!("clear"));
    let (status, head, _) = ask(&server, "/frame", &moving);
    assert!(status == 200 && head.contains("image/jpeg"), "{head}");
    let middle = json!({ "page": "a", "camera": look(9, "clear")["camera"] });
    let (_, _, depth) = ask(&server, "/depth", &middle);
    assert!(
        serde_json::from_slice::<Value>(&depth).unwrap()["depth"].is_number()
            || depth.starts_with(b"{\"depth\":null")
    );

    let state =
        |body: &Value, path: &str| serde_json::from_slice::<Value>(&ask(&server, path, body).2).unwrap();
    let before = state(&json!({}), "/state");
    live.figures("reef/reconstruct", 3, 10, &[("loss", 0.5), ("psnr", 20.0)]);
    live.show(Shown { step: Some(3), ..shown() });
    let after = state(&json!({}), "/state");
    assert_eq!((&after["step"], &after["loss"], &after["shownStep"]), (&json!(3), &json!(0.5), &json!(3)));
    assert_ne!(before["version"], after["version"]);
    assert_eq!(after["curves"]["psnr"], json!([[3, 20.0]]));
    assert_eq!(state(&json!({ "name": "pause" }), "/do")["paused"], json!(true));
    assert_eq!(state(&json!({ "name": "stop" }), "/do")["stopping"], json!(true));
    assert!(stop.load(Ordering::Relaxed));

    live.hand_over(shown()).unwrap();
    let beginning = state(&json!({}), "/scene");
    assert_eq!((&beginning["drawn"], &beginning["header"]["count"]), (&json!("browser"), &json!(2)));
    let (_, head, packed) = ask(&server, "/section", &json!({ "name": "geometry" }));
    assert!(head.contains("application/gzip") && packed.starts_with(&[0x1f, 0x8b]));
    assert_eq!(ask(&server, "/section", &json!({ "name": "../scene" })).0, 404);
}

#[test]
fn a_page_that_asks_a_hundred_times_gets_its_newest_and_many_pages_share() {
    let live = Arc::new(Live::new("", None));
    let server = Server::start(None, &live).unwrap();
    live.show(shown());
    std::thread::scope(|scope| {
        let pages: Vec<_> = (0..10)
            .map(|page| {
                let server = &server;
                scope.spawn(move || {
                    let asked: Vec<u16> = std::thread::scope(|scope| {
                        let asked: Vec<_> = (0..10)
                            .map(|_| {
                                let mut look = look(64, "clear");
                                look["page"] = json!(format!("page {page}"));
                                scope.spawn(move || ask(server, "/frame", &look).0)
                            })
                            .collect();
                        asked.into_iter().map(|a| a.join().unwrap()).collect()
                    });
                    // Each request is answered: drawn, superseded, or refused for now.
                    assert!(asked.iter().all(|status| [200, 204, 503].contains(status)), "{asked:?}");
                    asked.iter().filter(|status| **status == 200).count()
                })
            })
            .collect();
        let drawn: usize = pages.into_iter().map(|page| page.join().unwrap()).sum();
        assert!(drawn > 0);
    });
    // A client that sends nothing, and one that reads nothing, do not block others.
    let silent = TcpStream::connect(("127.0.0.1", server.port())).unwrap();
    let mut deaf = TcpStream::connect(("127.0.0.1", server.port())).unwrap();
    let host = format!("localhost:{}", server.port());
    // It is another page, because a newer request of the same page takes the place of ours.
    let mut other = look(64, "clear");
    other["page"] = json!("deaf");
    let body = other.to_string();
    let request = format!(
        "POST /frame HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nAuthorization: Bearer {}\r\nContent-Length: {}\r\n\r\n{body}",
        token(&server),
        body.len()
    );
    deaf.write_all(request.as_bytes()).unwrap();
    assert_eq!(ask(&server, "/frame", &look(64, "clear")).0, 200);
    drop((silent, deaf));
}

fn connected(server: &Server) -> TcpStream {
    TcpStream::connect(("127.0.0.1", server.port())).unwrap()
}

/// Sends a request with the token over a connection that stays open, and returns true if it is answered.
fn answers(server: &Server, stream: &mut TcpStream) -> bool {
    let host = format!("localhost:{}", server.port());
    let request = format!(
        "POST /state HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nAuthorization: Bearer {}\r\n\
         Content-Length: 2\r\n\r\n{{}}",
        token(server)
    );
    stream.write_all(request.as_bytes()).unwrap();
    // The whole answer is read, so that the next call does not begin in this one's body.
    let (mut answer, mut block) = (String::new(), [0; 4096]);
    loop {
        let read = stream.read(&mut block).unwrap();
        answer += &String::from_utf8_lossy(&block[..read]);
        let whole = answer.split_once("\r\n\r\n").is_some_and(|(head, body)| {
            let length = head
                .lines()
                .find_map(|line| line.to_lowercase().strip_prefix("content-length:")?.trim().parse().ok());
            length.is_none_or(|length: usize| body.len() >= length)
        });
        if read == 0 || whole {
            return answer.starts_with("HTTP/1.1 200");
        }
    }
}

#[test]
fn one_page_too_many_is_told_so_whatever_it_sends() {
    let server = Server::start(None, &Arc::new(Live::new("", None))).unwrap();
    let mut known: Vec<TcpStream> = (0..56).map(|_| connected(&server)).collect();
    assert!(known.iter_mut().all(|stream| answers(&server, stream)));
    let long = json!({ "name": "x".repeat(60_000) });
    for _ in 0..10 {
        let (status, _, body) = ask(&server, "/state", &long);
        assert!(status == 503 && String::from_utf8_lossy(&body).contains("too many"), "{status}");
    }
    drop(known);
}

#[test]
fn a_taken_port_is_said() {
    let taken = TcpListener::bind(("127.0.0.1", 0)).unwrap();
    let port = taken.local_addr().unwrap().port();
    let error = Server::start(Some(port), &Arc::new(Live::new("", None))).unwrap_err();
    assert!(
        matches!(error, ServerError::PortTaken(p) if p == port) && error.to_string().contains("--port"),
        "{error}"
    );
}

#[test]
fn a_place_is_measured_and_its_gains_reach_the_pictures() {
    let live = Arc::new(Live::new("", None));
    let server = Server::start(None, &live).unwrap();
    live.show(shown());
    // So near that the surface is larger than the patch.
    let mut camera = look(256, "clear")["camera"].clone();
    (camera["lens"], camera["height"]) = (json!([160, 160, 128, 96]), json!(192));
    let patch = |x: f64, y: f64, water: f64| {
        ask(&server, "/patch", &json!({ "page": "a", "camera": camera, "x": x, "y": y, "water": water }))
    };
    let (status, _, body) = patch(128.0, 96.0, 1.0);
    let found: Value = serde_json::from_slice(&body).unwrap();
    assert_eq!(status, 200);
    let colors = found["colors"].as_array().unwrap_or_else(|| panic!("{found}"));
    assert!(colors.len() == 3 && found["depth"].as_f64().is_some_and(|z| z > 1.0), "{found}");
    let nothing: Value = serde_json::from_slice(&patch(4.0, 4.0, 1.0).2).unwrap();
    assert!(nothing["problem"].as_str().is_some_and(|text| text.contains("no surface")), "{nothing}");
    assert_eq!(patch(128.0, 96.0, 1.5).0, 400);
    // The balanced picture differs; gains out of range are refused.
    let of = |red: f64| {
        let mut asked = look(64, "clear");
        let same = json!([1, 1, 1]);
        asked["white"] = json!({ "clear": [red, 1, 1], "enhanced": same, "enhanced-clear": same });
        ask(&server, "/frame", &asked)
    };
    let plain = ask(&server, "/frame", &look(64, "clear"));
    assert_eq!((plain.0, of(1.0).2 == plain.2, of(0.5).2 == plain.2), (200, true, false));
    assert_eq!((of(50.0).0, of(-1.0).0), (400, 400));
}

/// Slow connections without the token cannot keep a client with the token out.
#[test]
fn slow_strangers_make_room_for_who_knows_the_token() {
    let server = Server::start(None, &Arc::new(Live::new("", None))).unwrap();
    let address = ("127.0.0.1", server.port());
    // A connection that has shown the token stays, however many others come.
    let mut known = connected(&server);
    assert!(answers(&server, &mut known));
    let slow: Vec<TcpStream> = (0..100)
        .map(|_| {
            let mut stream = TcpStream::connect(address).unwrap();
            stream.write_all(b"GET / HT").unwrap();
            stream
        })
        .collect();
    for _ in 0..15 {
        assert_eq!(ask(&server, "/state", &json!({})).0, 200);
    }
    assert!(answers(&server, &mut known));
    drop(slow);
}
