// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/printable.h"

#include <doctest/doctest.h>

namespace printable_test {

using namespace vla;

TEST_CASE("letters of all languages are printed as they are") {
  for (const char* text : {"", "open the drawer", "öffne die Schublade", "打开抽屉", "🤖"}) {
    CHECK(printable(text) == text);
    CHECK(is_printable(text));
  }
}

TEST_CASE("what moves the cursor or turns the writing is printed as its number") {
  CHECK(printable("a\033[2Jb\n") == "a\\x1b[2Jb\\x0a");
  CHECK(printable("\u0085 \u202e\u2028") == "\\u{0085} \\u{202e}\\u{2028}");
  CHECK_FALSE(is_printable("a\nb"));
  CHECK_FALSE(is_printable("\u202e"));
}

TEST_CASE("bytes that are no UTF-8 are printed one by one") {
  CHECK(printable("\xff") == "\\xff");
  CHECK(printable("\xc3") == "\\xc3");                             // cut off
  CHECK(printable("\xc0\xaf") == "\\xc0\\xaf");                    // longer than it must be
  CHECK(printable("\xed\xa0\x80") == "\\xed\\xa0\\x80");           // half of a pair of UTF-16
  CHECK(printable("\xf4\x90\x80\x80") == "\\xf4\\x90\\x80\\x80");  // beyond the last character
  CHECK_FALSE(is_printable("ok\xff"));
}

}  // namespace printable_test
