//! What an operator sees: metrics, the log, request ids.

use super::{Server, head, neighbors, tile, whole};
use crate::wire::interop::run_python;
use rpfd::filter::Rect;
use serde_json::Value;
use std::{io::Write, process::Command};

const METRICS: [&str; 2] = ["--metrics-listen", "127.0.0.1:0"];

#[test]
fn what_happens_is_counted() {
    let server = Server::start(&METRICS);
    assert_eq!(server.metric("rpfd_tiles_total{outcome=\"filtered\"}"), Some(0.0));
    let both = [tile([32, 16], Rect::new(0, 0, 16, 16), 0), tile([32, 16], Rect::new(16, 0, 16, 16), 0)].concat();
    assert_eq!(server.post("/v1/filter", &both).messages().len(), 3);
    assert_eq!(server.post("/v1/images", br#"{"width": 32, "height": 16, "id": "x"}"#).status, 201);
    assert_eq!(server.post("/v1/images/x/tiles", &both).lines().len(), 3);
    assert_eq!(server.post("/v1/images/x/tiles", &[&both[..], b"no tile"].concat()).lines().len(), 4);
    server.post("/v1/filter", b"nonsense").problem(400, "not_a_tile");
    server.get("/v1/images/none").problem(404, "unknown_image");
    for (name, value) in [
        ("rpfd_tiles_total{outcome=\"filtered\"}", 4.0),
        ("rpfd_tiles_total{outcome=\"repeated\"}", 2.0),
        ("rpfd_tiles_total{outcome=\"failed\"}", 1.0),
        ("rpfd_tile_phase_seconds_count{phase=\"queue\"}", 6.0),
        ("rpfd_tile_phase_seconds_count{phase=\"receive\"}", 6.0),
        ("rpfd_tile_phase_seconds_count{phase=\"turn\"}", 6.0),
        ("rpfd_tile_phase_seconds_count{phase=\"filter\"}", 4.0),
        ("rpfd_tile_phase_seconds_count{phase=\"write\"}", 4.0),
        ("rpfd_requests_total{route=\"/v1/images/{id}\",method=\"GET\",status=\"404\"}", 1.0),
        ("rpfd_requests_total{route=\"/v1/filter\",method=\"POST\",status=\"200\"}", 1.0),
        ("rpfd_problems_total{code=\"unknown_image\"}", 1.0),
        ("rpfd_problems_total{code=\"trailing\"}", 1.0),
        ("rpfd_images_open", 1.0),
        ("rpfd_queue_length", 0.0),
        ("rpfd_memory_used_bytes", 0.0),
        ("rpfd_memory_limit_bytes", (1u64 << 30) as f64),
        ("rpfd_ready", 1.0),
        (concat!("rpfd_build_info{version=\"", env!("CARGO_PKG_VERSION"), "\"}"), 1.0),
    ] {
        super::wait_until(name, || server.metric(name) == Some(value));
    }
    assert!(server.metric("process_resident_memory_bytes").unwrap() > 1e6);
    assert!(server.metric("rpfd_disk_size_bytes") >= server.metric("rpfd_disk_free_bytes"));
    // Nothing of it is served where the work is done.
    server.get("/metrics").problem(404, "not_found");
}

#[test]
fn regions_and_disk_are_counted() {
    let server = Server::start(&[&METRICS[..], &["--disk", "3GiB"]].concat());
    let limit = server.metric("rpfd_images_disk_limit_bytes");
    assert_eq!((limit, server.metric("rpfd_images_disk_bytes")), (Some(f64::from(3 << 29) * 2.0), Some(0.0)));
    let opened = server.post("/v1/images", &neighbors::opening("a", [128, 64], "lean", ("samples", 4))).json();
    assert_eq!(server.metric("rpfd_images_disk_bytes"), opened["disk"].as_f64());
    let cores = [Rect::new(0, 0, 64, 64), Rect::new(64, 0, 64, 64)];
    let body: Vec<u8> = cores.iter().flat_map(|&core| tile([128, 64], core, 0)).collect();
    assert_eq!(server.post("/v1/images/a/tiles", &body).lines().len(), 3);
    neighbors::wait_complete(&server, "a");
    let regions = opened["regions"].as_f64().unwrap();
    for (name, value) in [
        ("rpfd_regions_total{outcome=\"filtered\"}", regions),
        ("rpfd_regions_total{outcome=\"failed\"}", 0.0),
        ("rpfd_tiles_total{outcome=\"stored\"}", 2.0),
        // Tiles and regions wait, are read, and are written; regions alone are filtered.
        ("rpfd_tile_phase_seconds_count{phase=\"queue\"}", 2.0 + regions),
        ("rpfd_tile_phase_seconds_count{phase=\"receive\"}", 2.0 + regions),
        ("rpfd_tile_phase_seconds_count{phase=\"turn\"}", 2.0 + regions),
        ("rpfd_tile_phase_seconds_count{phase=\"filter\"}", regions),
        ("rpfd_tile_phase_seconds_count{phase=\"write\"}", 2.0 + regions),
        ("rpfd_queue_length", 0.0),
    ] {
        super::wait_until(name, || server.metric(name) == Some(value));
    }
    assert_eq!(server.call("DELETE", "/v1/images/a", &[], &[]).status, 204);
    super::wait_until("the disk is free", || server.metric("rpfd_images_disk_bytes") == Some(0.0));
}

/// Series, without their values.
fn series(text: &str) -> usize {
    text.lines().filter(|line| !line.starts_with('#')).count()
}

#[test]
fn labels_are_few_whatever_is_sent() {
    let server = Server::start(&METRICS);
    let ask = |i: u32| {
        server.get(&format!("/v1/images/image-{i}"));
        server.get(&format!("/path/{i}"));
        server.call(&format!("METHOD{i}"), &format!("/other/{i}"), &[], &[]);
        server.post(&format!("/v1/filter?parameter{i}=1"), &[]);
    };
    // The last of them is counted when all of its answer is sent.
    let counted = || super::wait_until("all is counted", || server.metric("rpfd_requests_in_flight") == Some(0.0));
    ask(0);
    counted();
    let before = series(&server.metrics());
    (1..20).for_each(ask);
    counted();
    assert_eq!(series(&server.metrics()), before);
}

#[test]
fn a_strict_reader_reads_the_metrics() {
    let server = Server::start(&METRICS);
    server.post("/v1/filter", &whole(16)).messages();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.txt");
    std::fs::write(&path, server.metrics()).unwrap();
    let script = "import sys\nfrom prometheus_client.openmetrics.parser import text_string_to_metric_families as parse\n\
                  families = list(parse(open(sys.argv[1]).read()))\nprint(len(families))";
    let Some(output) = run_python("prometheus_client", "-c".as_ref(), &[script.as_ref(), path.as_ref()]) else {
        return;
    };
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(
        output.status.success() && said.trim().parse::<u32>().unwrap() > 12,
        "{said} {}",
        String::from_utf8_lossy(&output.stderr)
    );
}

#[test]
fn a_request_has_an_id_everywhere() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    let server = Server::start_logging(&["--log-format", "json"], Some(&log));
    let (trace, parent) = ("4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7");
    let traceparent = format!("traceparent: 00-{trace}-{parent}-01");
    let answer = server.call("POST", "/v1/filter", &["X-Request-Id: shot-12", &traceparent], &whole(16));
    assert_eq!(answer.messages().len(), 2);
    assert_eq!(answer.header("x-request-id"), Some("shot-12"));
    let response: Vec<_> = answer.header("traceresponse").unwrap().split('-').collect();
    assert!(response[..2] == ["00", trace] && response[2] != parent && response[3] == "01", "{response:?}");
    let refused = server.call("GET", "/nowhere", &["X-Request-Id: a b", "traceparent: 00-nonsense"], &[]);
    let id = refused.header("x-request-id").unwrap().to_owned();
    assert_eq!(id.len(), 32);
    assert_eq!(refused.problem(404, "not_found")["request_id"], id.as_str());
    assert_eq!(refused.header("traceresponse"), None);
    assert_eq!(server.terminate().code(), Some(0));
    let text = std::fs::read_to_string(&log).unwrap();
    let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let of = |message: &str, id: &str| lines.iter().any(|line| line["message"] == message && line["span"]["id"] == id);
    // The work that goes on beside the request has its id too.
    assert!(of("request", "shot-12") && of("tile stream done", "shot-12") && of("request", &id), "{text}");
    let traced = lines.iter().find(|line| line["span"]["id"] == "shot-12").unwrap();
    assert_eq!(
        (&traced["span"]["trace_id"], &traced["span"]["parent_id"]),
        (&Value::from(trace), &Value::from(parent))
    );
    assert_eq!(traced["span"]["span_id"], response[2]);
}

#[test]
fn a_full_disk_is_no_place_for_work() {
    let server = Server::start(&[&METRICS[..], &["--disk-reserve", "1000000TiB"]].concat());
    let problem = server.get("/readyz").problem(503, "low_disk");
    assert!(problem["detail"].as_str().unwrap().contains("1000000TiB"), "{problem}");
    assert_eq!(server.metric("rpfd_ready"), Some(0.0));
    assert_eq!(server.get("/livez").status, 200);
}

/// A real Prometheus reads what it is given, as the configuration in `deploy` has it.
#[test]
fn prometheus_reads_it() {
    if !super::has("prometheus", "--version") {
        return;
    }
    let server = Server::start(&METRICS);
    server.post("/v1/filter", &whole(16)).messages();
    let folder = tempfile::tempdir().unwrap();
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/prometheus");
    let text = std::fs::read_to_string(root.join("prometheus.yml")).unwrap();
    assert!(text.contains("rpfd:9090") && text.contains("scrape_interval: 15s"));
    let text = text
        .replace("rpfd:9090", server.metrics.as_ref().unwrap())
        .replace("scrape_interval: 15s", "scrape_interval: 1s");
    std::fs::write(folder.path().join("prometheus.yml"), text).unwrap();
    std::fs::copy(root.join("alerts.yml"), folder.path().join("alerts.yml")).unwrap();
    let log = folder.path().join("log");
    let mut child = Command::new("prometheus")
        .arg(format!("--config.file={}", folder.path().join("prometheus.yml").display()))
        .arg(format!("--storage.tsdb.path={}", folder.path().join("data").display()))
        .arg("--web.listen-address=127.0.0.1:0")
        .stderr(std::fs::File::create(&log).unwrap())
        .spawn()
        .unwrap();
    // It says which port it got.
    let address = || {
        let said = std::fs::read_to_string(&log).unwrap();
        let address = said.split("msg=\"Listening on\" address=").nth(1)?.split_once('\n')?.0.to_owned();
        Some(address)
    };
    let ask = |query: &str| {
        let mut stream = std::net::TcpStream::connect(address()?).ok()?;
        let path = format!("/api/v1/query?query={query}");
        stream.write_all(head("GET", &path, &[], 0).as_bytes()).ok()?;
        let answer = super::Answer::read(&mut stream);
        if answer.status != 200 {
            return None;
        }
        answer.json()["data"]["result"][0]["value"][1].as_str().map(ToOwned::to_owned)
    };
    let read = std::panic::catch_unwind(|| {
        super::wait_until("Prometheus has read the service", || ask("up").as_deref() == Some("1"));
        super::wait_until("Prometheus knows the tiles", || {
            ask("rpfd_tiles_total%7Boutcome=%22filtered%22%7D").as_deref() == Some("1")
        });
    });
    let _ = child.kill();
    let _ = child.wait();
    read.unwrap();
}
