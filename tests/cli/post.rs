//! `rpfd post` against a service that does what the test says.

use super::*;
use std::{
    io::{BufRead, BufReader, Read, Write},
    net::{TcpListener, TcpStream},
    sync::{Arc, Mutex},
};

/// A request as the service saw it.
#[derive(Clone, Debug)]
struct Request {
    /// Method and path.
    what: String,
    body: Vec<u8>,
}

/// What to answer: a status line's end, further headers, and a body; nothing is a cut connection.
type Answer = Option<(&'static str, &'static str, Vec<u8>)>;

/// Starts a service; `answer` is called with each request and its number.
fn service(answer: impl Fn(usize, &Request) -> Answer + Send + Sync + 'static) -> (String, Arc<Mutex<Vec<Request>>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let (seen, answer) = (Arc::new(Mutex::new(Vec::new())), Arc::new(answer));
    let all = seen.clone();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let (all, answer) = (all.clone(), answer.clone());
            std::thread::spawn(move || serve(&stream.unwrap(), &all, &*answer));
        }
    });
    (url, seen)
}

fn serve(stream: &TcpStream, all: &Mutex<Vec<Request>>, answer: &dyn Fn(usize, &Request) -> Answer) -> Option<()> {
    let mut reader = BufReader::new(stream);
    let mut head = Vec::new();
    loop {
        let mut line = String::new();
        reader.read_line(&mut line).ok().filter(|&len| len > 2)?;
        head.clear();
        head.push(line);
        loop {
            let mut line = String::new();
            reader.read_line(&mut line).ok()?;
            if line == "\r\n" {
                break;
            }
            head.push(line.to_ascii_lowercase());
        }
        let length =
            head.iter().find_map(|line| line.strip_prefix("content-length:")?.trim().parse().ok()).unwrap_or(0);
        let mut body = vec![0; length];
        reader.read_exact(&mut body).ok()?;
        let what = head[0].rsplit_once(' ').unwrap().0.to_owned();
        let request = Request { what, body };
        let number = {
            let mut all = all.lock().unwrap();
            all.push(request.clone());
            all.len() - 1
        };
        let (status, headers, body) = answer(number, &request)?;
        let head = format!("HTTP/1.1 {status}\r\ncontent-length: {}\r\n{headers}\r\n", body.len());
        let mut stream = stream;
        stream.write_all(&[head.as_bytes(), &body].concat()).ok()?;
    }
}

/// Opens any image.
fn opened(request: &Request) -> Answer {
    let body: Value = serde_json::from_slice(&request.body).unwrap();
    Some(("201 Created", "", format!("{{\"id\":{}}}", body["id"]).into_bytes()))
}

/// The core that a tile's header announces, as the lines of an answer have it.
fn core(request: &Request) -> Value {
    let mut decoder = rpfd::wire::Decoder::new();
    let event = decoder.next(&mut &request.body[..]).unwrap();
    let Some(rpfd::wire::Event::Header(header)) = event else { panic!("no header") };
    let core = header.geometry().core();
    serde_json::json!([core.x, core.y, core.width, core.height])
}

fn stored(request: &Request, state: &str) -> Answer {
    let line = format!(
        "{{\"tile\":{},\"state\":\"{state}\"}}\n{{\"state\":\"end\",\"tiles\":1,\"errors\":0}}\n",
        core(request)
    );
    Some(("200 OK", "", line.into_bytes()))
}

fn problem(status: &'static str, code: &str) -> Answer {
    let body = format!("{{\"code\":\"{code}\",\"title\":\"No\",\"detail\":\"because of {code}\"}}");
    Some((status, "retry-after: 0\r\n", body.into_bytes()))
}

fn post<'a>(url: &'a str, out: &'a str) -> Vec<String> {
    let input = data("small.tiles.zst").into_os_string().into_string().unwrap();
    ["post", &input, "--to", url, "-o", out, "--tile", "32"].map(str::to_owned).to_vec()
}

#[test]
fn what_may_pass_is_sent_again_until_it_works() {
    let folder = Folder::new();
    let (url, seen) = service(|number, request| match request.what.as_str() {
        "POST /v1/images" if number == 0 => problem("503 Service Unavailable", "busy"),
        "POST /v1/images" => opened(request),
        "POST /v1/images/frame/tiles" if number == 3 => None,
        "POST /v1/images/frame/tiles" if number == 4 => problem("429 Too Many Requests", "slow_down"),
        // The line of a tile that found no memory, and one that is cut off.
        "POST /v1/images/frame/tiles" if number == 5 => Some((
            "200 OK",
            "",
            b"{\"tile\":null,\"state\":\"error\",\"problem\":{\"status\":503,\"code\":\"busy\"}}\n".to_vec(),
        )),
        "POST /v1/images/frame/tiles" if number == 6 => Some(("200 OK", "", b"{\"tile\":[0,0".to_vec())),
        "POST /v1/images/frame/tiles" => stored(request, if number % 2 == 0 { "filtered" } else { "repeated" }),
        what if what.starts_with("GET /v1/images/frame/result.exr?") => Some(("200 OK", "", b"exr".to_vec())),
        what => panic!("{what}"),
    });
    let out = folder.path("out.exr");
    let report = json(
        post(&url, &out)
            .into_iter()
            .chain(["--id", "frame", "--seed", "7", "--set", "bins=9", "--half"].map(str::to_owned))
            .chain(["--leave-out", "off", "--tolerance", "1e-3"].map(str::to_owned)),
    );
    assert_eq!((&report["tiles"], &report["id"]), (&4.into(), &"frame".into()));
    assert_eq!(bytes(&out), b"exr");
    let seen = seen.lock().unwrap();
    let open: Value = serde_json::from_slice(&seen[1].body).unwrap();
    let expected = serde_json::json!({
        "id": "frame", "width": 48, "height": 48, "preset": "lean", "seed": 7, "bins": "9", "tolerance": "1e-3", "leave_out": false,
    });
    assert_eq!(open, expected);
    assert_eq!(seen.iter().filter(|r| r.what.ends_with("tiles")).count(), 8);
    let fetch = seen.iter().find(|r| r.what.starts_with("GET")).unwrap();
    assert!(fetch.what.contains("samples=half") && fetch.what.contains("compression=zip"), "{}", fetch.what);
    // Each tile has the halo that the preset reads.
    let tile = seen.iter().find(|r| r.what.ends_with("tiles")).unwrap();
    let mut decoder = rpfd::wire::Decoder::new();
    let Some(rpfd::wire::Event::Header(header)) = decoder.next(&mut &tile.body[..]).unwrap() else { panic!() };
    assert_eq!(header.geometry().halo(), header.geometry().halo_for(17));
}

#[test]
fn what_the_service_refuses_exits_with_4() {
    let folder = Folder::new();
    let out = folder.path("out.exr");
    type Service = fn(usize, &Request) -> Answer;
    let services: [(&str, Service); 4] = [
        ("too_many_images", |_, _| problem("429 Too Many Requests", "too_many_images")),
        ("id_conflict", |_, _| problem("409 Conflict", "id_conflict")),
        ("tile_conflict", |number, request| match number {
            0 => opened(request),
            _ => {
                let line = format!(
                    "{{\"tile\":{},\"state\":\"error\",\"problem\":{{\"status\":409,\"code\":\"tile_conflict\",\"detail\":\"other samples\"}}}}\n",
                    core(request)
                );
                Some(("200 OK", "", line.into_bytes()))
            }
        }),
        ("image_incomplete", |_, request| match request.what.split('/').next_back() {
            Some("images") => opened(request),
            Some("tiles") => stored(request, "filtered"),
            _ => problem("409 Conflict", "image_incomplete"),
        }),
    ];
    for (expected, answer) in services {
        let (url, _) = service(answer);
        let (code, message) = fails(4, post(&url, &out).into_iter().chain(["--attempts".to_owned(), "2".to_owned()]));
        assert_eq!(code, expected, "{message}");
        assert_eq!(folder.names(), [""; 0]);
    }
}

#[test]
fn no_service_exits_with_1() {
    let folder = Folder::new();
    let out = folder.path("out.exr");
    let once = ["--attempts".to_owned(), "1".to_owned()];
    let (code, message) = fails(1, post("http://127.0.0.1:1", &out).into_iter().chain(once.clone()));
    assert_eq!(code, "unreachable", "{message}");
    // Somebody else's service.
    let (url, _) = service(|_, _| Some(("200 OK", "", b"<html>hello</html>".to_vec())));
    assert_eq!(fails(1, post(&url, &out).into_iter().chain(once.clone())).0, "bad_answer");
    // An EXR that is cut off.
    let (url, _) = service(|_, request| match request.what.split(['/', '?']).nth(4) {
        None => opened(request),
        Some("tiles") => stored(request, "filtered"),
        _ => Some(("200 OK", "x-more: \r\ncontent-length: 100\r\n", b"exr".to_vec())),
    });
    assert_eq!(fails(1, post(&url, &out).into_iter().chain(once)).0, "unreachable");
    assert_eq!(folder.names(), [""; 0]);
}
