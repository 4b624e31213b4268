//! TLS in front of the service, as `deploy/nginx` has it: a real nginx, a certificate made for the test, and curl.

use super::{Answer, Server, has, tile};
use crate::cli::{Folder, data, rpfd, stderr};
use rpfd::filter::Rect;
use std::{
    net::TcpListener,
    path::Path,
    process::{Child, Command},
};

struct Proxy {
    child: Child,
    folder: Folder,
    address: String,
}

impl Drop for Proxy {
    fn drop(&mut self) {
        // It is the master: its workers end with it.
        let id = self.child.id().to_string();
        let _ = Command::new("kill").args(["-QUIT", &id]).status();
        let _ = self.child.wait();
    }
}

/// Starts nginx on a port that is free; if somebody else takes it meanwhile, on another.
fn proxy(server: &Server) -> Proxy {
    (0..20).find_map(|_| try_proxy(server)).expect("a port that stays free")
}

/// Starts nginx with the example, its addresses and files replaced by those of the test.
fn try_proxy(server: &Server) -> Option<Proxy> {
    let folder = Folder::new();
    let (ca, ca_key) = (folder.path("ca.pem"), folder.path("ca.key"));
    let (certificate, key) = (folder.path("cert.pem"), folder.path("key.pem"));
    let make = |arguments: &[&str]| {
        let request =
            ["req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"];
        let made = Command::new("openssl").args(request).args(arguments).output().unwrap();
        assert!(made.status.success(), "{}", stderr(&made));
    };
    make(&["-subj", "/CN=CA of a test", "-keyout", &ca_key, "-out", &ca]);
    let names = ["-addext", "subjectAltName=DNS:localhost", "-addext", "basicConstraints=critical,CA:FALSE"];
    let signed = ["-CA", &ca, "-CAkey", &ca_key, "-subj", "/CN=localhost", "-keyout", &key, "-out", &certificate];
    make(&[&names[..], &signed[..]].concat());
    let example =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/nginx/rpfd.conf")).unwrap();
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut site = example;
    for (from, to) in [
        ("127.0.0.1:8080", server.address.clone()),
        ("listen 443 ", format!("listen {port} ")),
        ("/etc/ssl/rpfd/cert.pem", certificate),
        ("/etc/ssl/rpfd/key.pem", key),
        ("rpfd.example.com", "localhost".to_owned()),
        ("    listen [::]:443 ssl http2;\n", String::new()),
    ] {
        assert!(site.contains(from), "the example has no {from:?}");
        site = site.replace(from, &to);
    }
    let temporary: String = ["client_body", "proxy", "fastcgi", "uwsgi", "scgi"]
        .map(|name| format!("{name}_temp_path {};\n", folder.path(name)))
        .concat();
    let (pid, log) = (folder.path("nginx.pid"), folder.path("error.log"));
    let main = format!(
        "daemon off;\npid {pid};\nerror_log {log};\nevents {{}}\nhttp {{\naccess_log off;\n{temporary}{site}\n}}\n"
    );
    let path = folder.path("nginx.conf");
    std::fs::write(&path, main).unwrap();
    let mut child = Command::new("nginx").args(["-c", &path, "-e", &log]).spawn().unwrap();
    // It says who it is when it listens.
    let mut ended = false;
    super::wait_until("nginx listens", || {
        ended = child.try_wait().unwrap().is_some();
        ended || std::fs::read_to_string(&pid).is_ok_and(|id| !id.is_empty())
    });
    (!ended).then(|| Proxy { child, folder, address: format!("localhost:{}", port.port()) })
}

#[test]
fn tiles_stream_through_tls() {
    if !(has("nginx", "-v") && has("openssl", "version") && has("curl", "--version")) {
        return;
    }
    let folder = Folder::new();
    let secret = folder.path("farm.token");
    let entry = rpfd(["token", "farm", "--secret", &secret]);
    let tokens = folder.path("tokens.toml");
    std::fs::write(&tokens, &entry.stdout).unwrap();
    let server = Server::start(&["--token-file", &tokens]);
    let proxy = proxy(&server);
    let token = std::fs::read_to_string(&secret).unwrap();
    let (authorization, input) = (format!("Authorization: Bearer {}", token.trim()), folder.path("in.tiles"));
    std::fs::write(
        &input,
        [tile([48, 16], Rect::new(0, 0, 16, 16), 0), tile([48, 16], Rect::new(16, 0, 32, 16), 0)].concat(),
    )
    .unwrap();
    let url = |path: &str| format!("https://{}{path}", proxy.address);
    let certificate = proxy.folder.path("ca.pem");
    let curl = |arguments: &[&str]| {
        let output = Command::new("curl")
            .args(["-sSi", "-H", "Expect:", "--cacert", &certificate])
            .args(arguments)
            .output()
            .unwrap();
        assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
        output.stdout
    };
    for version in ["--http1.1", "--http2"] {
        let bytes = curl(&[version, "-H", &authorization, "-T", &input, &url("/v1/filter")]);
        let end = bytes.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        let head = String::from_utf8(bytes[..end].to_vec()).unwrap().to_lowercase();
        assert!(head.contains(" 200") && head.contains("x-request-id: "), "{head}");
        let headers = vec![("content-type".to_owned(), "application/msgpack".to_owned())];
        assert_eq!(Answer { status: 200, headers, body: bytes[end + 4..].to_vec() }.messages().len(), 3);
    }
    let refused = String::from_utf8(curl(&["--http1.1", "-T", &input, &url("/v1/filter")])).unwrap();
    assert!(
        refused.contains("401")
            && refused.contains("missing_token")
            && refused.to_lowercase().contains("www-authenticate"),
        "{refused}"
    );
    // The metrics are not to be had from outside.
    let hidden = String::from_utf8(curl(&["--http1.1", "-H", &authorization, &url("/metrics")])).unwrap();
    assert!(hidden.contains("404"), "{hidden}");
    nothing_is_held_back(&proxy, &authorization, &certificate);
    // Our own client, which trusts what the system trusts, and here this certificate.
    let (out, to) = (folder.path("out.exr"), url(""));
    let post = [
        "post",
        data("small.tiles.zst").to_str().unwrap(),
        "--to",
        &to,
        "-o",
        &out,
        "--preset",
        "unfiltered",
        "--token-file",
        &secret,
    ]
    .map(ToOwned::to_owned);
    let output =
        Command::new(env!("CARGO_BIN_EXE_rpfd")).args(post).env("SSL_CERT_FILE", &certificate).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
}

/// Half of a stream is sent, and its result must come before the other half: neither way is anything buffered.
fn nothing_is_held_back(proxy: &Proxy, authorization: &str, certificate: &str) {
    use std::io::{Read, Write};
    let mut child = Command::new("curl")
        .args(["-sN", "--no-progress-meter", "--http1.1", "--cacert", certificate, "-H", authorization, "-T", "."])
        .arg(format!("https://{}/v1/filter", proxy.address))
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let (mut stdin, mut stdout) = (child.stdin.take().unwrap(), child.stdout.take().unwrap());
    stdin.write_all(&tile([32, 16], Rect::new(0, 0, 16, 16), 0)).unwrap();
    stdin.flush().unwrap();
    // Blocks for ever, and with it the test, if the result waits for the end of the request.
    let mut first = vec![0; 1000];
    stdout.read_exact(&mut first).unwrap();
    stdin.write_all(&tile([32, 16], Rect::new(16, 0, 16, 16), 0)).unwrap();
    drop(stdin);
    let mut body = first;
    stdout.read_to_end(&mut body).unwrap();
    assert!(child.wait().unwrap().success());
    let headers = vec![("content-type".to_owned(), "application/msgpack".to_owned())];
    assert_eq!(Answer { status: 200, headers, body }.messages().len(), 3);
}
