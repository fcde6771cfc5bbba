"""What proxies and previews send to the viewer, and what pages of other sites may not."""

import json

import pytest

from sehdr_warp.cli import parse_command
from sehdr_warp.errors import UsageError
from sehdr_warp.viewer.server import Server, Viewer

from .test_server import ask

PUBLIC = "splats.example.org"


@pytest.fixture
def statuses(serve, monkeypatch):
    """Statuses of /scene for headers, by a server with or without a proxy's origin."""

    def of(origins=(), host="127.0.0.1"):
        server = serve()
        server.origins, server.host = origins, host
        port = server.server_address[1]
        cases = {
            "tunnel": {"Host": "localhost:8080", "Origin": "http://localhost:8080"},
            "tls tunnel": {"Host": "localhost:8443", "Origin": "https://localhost:8443"},
            "proxy": {"Host": PUBLIC, "Origin": f"https://{PUBLIC}"},
            "proxy that rewrites the host": {"Host": f"127.0.0.1:{port}", "Origin": f"https://{PUBLIC}"},
            "another site": {"Host": f"127.0.0.1:{port}", "Origin": "http://evil.example"},
            "another site by a name of its own": {"Host": "evil.example", "Origin": "http://evil.example"},
        }
        return {name: ask(server, "/scene", **headers)[0] for name, headers in cases.items()}

    return of


def test_a_local_viewer_answers_its_own_names(statuses):
    assert list(statuses().values()) == [200, 200, 403, 403, 403, 403]


def test_origin_lets_a_proxy_in_and_nobody_else(statuses):
    assert list(statuses(origins=(f"https://{PUBLIC}",)).values()) == [200, 200, 200, 200, 403, 403]


def test_a_viewer_of_the_network_answers_https_of_the_same_host(statuses):
    codes = statuses(host="0.0.0.0")
    assert codes["proxy"] == 200 and codes["another site"] == 403 and codes["proxy that rewrites the host"] == 403


def test_queries_are_ignored_and_addresses_are_relative(serve):
    server = serve()
    assert ask(server, "/?vscodeBrowserReqId=1")[0] == 200
    assert ask(server, "/scene?x=/../secret")[0] == 200
    page = ask(server, "/")[2].decode()
    script = ask(server, "/viewer.js")[2].decode()
    assert 'src="/' not in page and 'href="/' not in page and 'ask("/' not in script and "ask(`/" not in script


@pytest.mark.parametrize("prefix", ["/proxy/absolute/7007", "/user/me"])
def test_a_prefix_that_a_proxy_leaves_does_not_matter(serve, prefix):
    """jupyter-server-proxy's /proxy/absolute/PORT/ and nginx without a trailing slash; visdom pull request 978."""
    server = serve()
    for path in ("/", "/viewer.js", "/scene", "/photo/0/1"):
        assert ask(server, prefix + path)[0::2] == ask(server, path)[0::2]
    assert ask(server, f"{prefix}/nothing")[0] == 404


def test_head_is_a_get_without_content(serve):
    status, kind, content = ask(serve(), "/", method="HEAD")
    assert (status, kind, content) == (200, "text/html", b"")
    assert ask(serve(), "/nothing", method="HEAD")[0] == 404


def test_a_refusal_names_the_way_out(serve):
    status, _, content = ask(serve(), "/scene", Origin="https://evil.example")
    assert status == 403 and b"--origin https://ITS.NAME" in content


def test_previews_may_frame_the_page_and_sites_may_not():
    server = Server(Viewer([]), port=18300, origins=("https://a.example",))
    server.server_close()
    ancestors = server.security_policy.partition("frame-ancestors")[2].split()
    assert ancestors == ["'self'", "vscode-webview:", "https://a.example"]


def test_origins_are_checked(tmp_path):
    run, args = parse_command(["view", str(tmp_path), "--origin", "splats.example.org/x"])
    with pytest.raises(UsageError, match="write it as https://NAME"):
        run(args)
    assert (
        json.dumps(parse_command(["view", "r", "--origin", "https://a.example"])[1].origin) == '["https://a.example"]'
    )
