"""Administration in a browser: keys, the audit log by filters, backups, settings."""

import pytest

from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import serious_findings

pytestmark = pytest.mark.slow


def test_key_is_made_and_its_entry_of_the_audit_log_found(visit: Visit):
    page = visit.page
    visit.screen("Administration")
    keys = page.get_by_role("region", name="Keys").first
    keys.get_by_label("Name").fill("console of room 3")
    keys.get_by_label("read:stream").check()
    keys.get_by_role("button", name="Create a key").click()
    keys.get_by_text("This key is shown once").wait_for()
    audit = page.get_by_role("region", name="Audit log").first
    audit.get_by_label("Operation").fill("create-key")
    audit.get_by_label("Operation").press("Tab")
    row = audit.locator("tbody tr").filter(has_text="create-key").first
    row.wait_for()
    row.get_by_role("button").click()
    audit.get_by_text("console of room 3").wait_for()
    audit.get_by_label("Outcome").select_option("refused")
    audit.get_by_text("No entry agrees with the filters.").wait_for()
    audit.get_by_role("button", name="All entries").click()
    audit.locator("tbody tr").first.wait_for()
    page.get_by_text("There is no backup that the server knows of.").wait_for()
    settings = page.get_by_role("region", name="Settings in force").first
    settings.get_by_text("Largest request body [bytes].").wait_for()
    settings.get_by_label("only what is not as by default").check()
    settings.get_by_role("row").filter(has_text="data_dir").wait_for()
    settings.get_by_text("Largest request body [bytes].").wait_for(state="detached")
    assert serious_findings(page) == []
