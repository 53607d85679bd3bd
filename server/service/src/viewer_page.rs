//! The browser viewer: its built files (`client/web/dist`) lie in the binary and are served beside gRPC-Web, on the same port and origin.
//!
//! Everything that is called is a POST, so every GET and HEAD is for a file. Files below `assets/` have their contents' hash in their names
//! and never change; all others are asked for anew each time and have an ETag.

use std::future::{Ready, ready};
use std::task::{Context, Poll};

use bytes::Bytes;
use http::header::{CACHE_CONTROL, CONTENT_LENGTH, CONTENT_SECURITY_POLICY, CONTENT_TYPE, ETAG, IF_NONE_MATCH, REFERRER_POLICY};
use http::header::{X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS};
use http::{HeaderMap, HeaderName, HeaderValue, Method, Request, Response, StatusCode};
use include_dir::{Dir, File, include_dir};
use tokio_util::either::Either;
use tonic::body::Body;
use tower_layer::Layer;
use tower_service::Service;

/// What Vite names by a hash of its contents.
const HASHED: &str = "assets/";
const FOREVER: &str = "public, max-age=31536000, immutable";
const ASK_AGAIN: &str = "no-cache";
/// The page's own scripts and styles, calls to its own origin, and pictures that it makes itself; no frames, no forms, nothing inline.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; font-src 'self'; \
                      connect-src 'self'; worker-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
const OPENER_POLICY: HeaderName = HeaderName::from_static("cross-origin-opener-policy");
const RESOURCE_POLICY: HeaderName = HeaderName::from_static("cross-origin-resource-policy");
/// Digits of a hash that tell two contents apart.
const ETAG_DIGITS: usize = 32;

static FILES: Dir<'static> = include_dir!("$CARGO_MANIFEST_DIR/../../client/web/dist");

/// Puts the viewer before a service.
#[derive(Clone, Copy)]
pub struct ViewerPage;

impl<S> Layer<S> for ViewerPage {
    type Service = WithViewerPage<S>;

    fn layer(&self, inner: S) -> WithViewerPage<S> {
        WithViewerPage { inner }
    }
}

/// A service whose GETs are the viewer's files.
#[derive(Clone)]
pub struct WithViewerPage<S> {
    inner: S,
}

impl<S> Service<Request<Body>> for WithViewerPage<S>
where
    S: Service<Request<Body>, Response = Response<Body>>,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Either<Ready<Result<Response<Body>, S::Error>>, S::Future>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(cx)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        match *request.method() {
            Method::GET | Method::HEAD => Either::Left(ready(Ok(answer(request.method(), request.uri().path(), request.headers())))),
            _ => Either::Right(self.inner.call(request)),
        }
    }
}

fn answer(method: &Method, path: &str, headers: &HeaderMap) -> Response<Body> {
    let name = if path == "/" { "index.html" } else { path.strip_prefix('/').unwrap_or(path) };
    // Paths are compared part by part, "a/./b/" with "a/b"; names are not.
    let file = FILES.get_file(name).filter(|file| file.path().to_str() == Some(name));
    let Some(file) = file else {
        return finish(StatusCode::NOT_FOUND, "text/plain; charset=utf-8", method, "not found\n".into());
    };
    let etag = etag(file);
    let is_known = headers.get_all(IF_NONE_MATCH).iter().any(|known| names(known, &etag));
    let mut response = match is_known {
        true => finish(StatusCode::NOT_MODIFIED, content_type(name), method, Bytes::new()),
        false => finish(StatusCode::OK, content_type(name), method, Bytes::from_static(file.contents())),
    };
    let lasts = if name.starts_with(HASHED) { FOREVER } else { ASK_AGAIN };
    response.headers_mut().insert(CACHE_CONTROL, HeaderValue::from_static(lasts));
    response.headers_mut().insert(ETAG, etag);
    response
}

fn finish(status: StatusCode, content_type: &'static str, method: &Method, contents: Bytes) -> Response<Body> {
    let length = contents.len();
    let body = if method == Method::HEAD || contents.is_empty() { Body::empty() } else { Body::new(axum::body::Body::from(contents)) };
    let mut response = Response::new(body);
    *response.status_mut() = status;
    let headers = response.headers_mut();
    if status != StatusCode::NOT_MODIFIED {
        headers.insert(CONTENT_TYPE, HeaderValue::from_static(content_type));
        headers.insert(CONTENT_LENGTH, length.into());
    }
    let fixed = [
        (CONTENT_SECURITY_POLICY, POLICY),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (X_FRAME_OPTIONS, "DENY"),
        (REFERRER_POLICY, "no-referrer"),
        (OPENER_POLICY, "same-origin"),
        (RESOURCE_POLICY, "same-origin"),
    ];
    headers.extend(fixed.map(|(name, value)| (name, HeaderValue::from_static(value))));
    response
}

fn etag(file: &File) -> HeaderValue {
    let digits = &blake3::hash(file.contents()).to_hex()[..ETAG_DIGITS];
    HeaderValue::from_str(&format!("\"{digits}\"")).expect("hexadecimal digits are a header's value")
}

/// Whether an If-None-Match holds the tag, weak or not.
fn names(known: &HeaderValue, etag: &HeaderValue) -> bool {
    let tag = |text: &str| text.trim().trim_start_matches("W/").as_bytes() == etag.as_bytes() || text.trim() == "*";
    known.to_str().is_ok_and(|list| list.split(',').any(tag))
}

/// By the ending; what the viewer's build does not write is bytes.
fn content_type(name: &str) -> &'static str {
    match name.rsplit('.').next().unwrap_or_default() {
        "html" => "text/html; charset=utf-8",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "json" | "map" => "application/json",
        "webmanifest" => "application/manifest+json",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "jpg" | "jpeg" => "image/jpeg",
        "ico" => "image/x-icon",
        "woff2" => "font/woff2",
        "wasm" => "application/wasm",
        "txt" => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn get(path: &str, known: Option<&HeaderValue>) -> Response<Body> {
        let mut headers = HeaderMap::new();
        headers.extend(known.map(|tag| (IF_NONE_MATCH, tag.clone())));
        answer(&Method::GET, path, &headers)
    }

    fn names_below(folder: &Dir<'static>) -> Vec<String> {
        let own = folder.files().map(|file| file.path().to_str().unwrap().to_string());
        own.chain(folder.dirs().flat_map(names_below)).collect()
    }

    #[test]
    fn every_file_of_the_build_has_a_type_and_a_tag_that_saves_it_the_second_time() {
        for name in &names_below(&FILES) {
            let first = get(&format!("/{name}"), None);
            assert_eq!(first.status(), StatusCode::OK, "{name}");
            assert_ne!(first.headers()[CONTENT_TYPE], "application/octet-stream", "{name}");
            let lasts = if name.starts_with("assets/") { FOREVER } else { ASK_AGAIN };
            assert_eq!(first.headers()[CACHE_CONTROL], lasts, "{name}");
            let again = get(&format!("/{name}"), Some(&first.headers()[ETAG]));
            assert_eq!((again.status(), again.headers().get(CONTENT_LENGTH)), (StatusCode::NOT_MODIFIED, None), "{name}");
            let head = answer(&Method::HEAD, &format!("/{name}"), &HeaderMap::new());
            assert_eq!(head.headers()[CONTENT_LENGTH], first.headers()[CONTENT_LENGTH], "{name}");
            assert!(http_body::Body::is_end_stream(head.body()), "{name}: a head has no body");
            let other = get(&format!("/{name}"), Some(&HeaderValue::from_static("\"0\"")));
            assert_eq!(other.status(), StatusCode::OK, "{name}");
        }
        assert!(names(&HeaderValue::from_static("\"a\", W/\"b\""), &HeaderValue::from_static("\"b\"")));
    }

    #[test]
    fn the_page_is_at_the_root_and_nothing_is_outside_the_build() {
        let page = get("/", None);
        assert_eq!((page.status(), &page.headers()[CONTENT_TYPE]), (StatusCode::OK, &HeaderValue::from_static("text/html; charset=utf-8")));
        for path in ["/nothing", "//", "/assets", "/assets/", "/../Cargo.toml", "/%2e%2e/Cargo.toml", "/index.html/", "", "/\u{e4}"] {
            let response = get(path, None);
            // The tests of safety hold for errors, too.
            assert!(response.headers().contains_key(CONTENT_SECURITY_POLICY));
            assert_eq!(response.status(), StatusCode::NOT_FOUND, "{path:?}");
        }
    }

    /// What the policy forbids would not work: inline scripts and styles, and anything from elsewhere.
    #[test]
    fn the_page_keeps_its_own_policy() {
        let page = String::from_utf8(FILES.get_file("index.html").unwrap().contents().to_vec()).unwrap();
        let breaches = |page: &str| {
            let inline = page.matches("<script").count() - page.matches("src=").count().min(page.matches("<script").count());
            inline + ["<style", " style=", " onload=", " onclick=", "http://", "https://"].iter().filter(|b| page.contains(*b)).count()
        };
        assert_eq!(breaches(&page), 0, "{page}");
        assert_eq!(breaches("<script>1</script>"), 1);
        assert_eq!(breaches("<p style='x'><script src='https://a'></script>"), 2);
    }
}
