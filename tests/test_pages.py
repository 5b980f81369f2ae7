"""Every page is filled in alike: by text, and by all that its template names."""

import jinja2
import pytest

from tog_drake.pages import page_environment


def test_what_a_template_names_but_nobody_gave_is_an_error_and_no_gap_in_the_page():
    with pytest.raises(jinja2.UndefinedError, match="answer"):
        page_environment().from_string("It said {{ answer }}.").render(answers=[])


def test_what_is_entered_is_text_and_never_markup():
    page = page_environment().from_string("{{ said }}").render(said="<b onclick='x'>")
    assert page == "&lt;b onclick=&#39;x&#39;&gt;"
