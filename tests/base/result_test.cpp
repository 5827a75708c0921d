// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/result.h"

#include <doctest/doctest.h>

namespace result_test {

using namespace vla;

TEST_CASE("the message of an error says what was found, also where that is an empty text") {
  CHECK(Error{Code::usage, "--text", "a sentence", ""}.message() == "--text: expected a sentence, found nothing");
  CHECK(Error{Code::usage, "vla.arch", "pi0", "", "convert again"}.message() ==
        "vla.arch: expected pi0, found nothing; convert again");
  CHECK(Error{Code::usage, "vla.arch", "pi0", "evo1"}.found == "evo1");
  CHECK(Error{Code::internal, "act", "", "an exception"}.message() == "act: an exception");
}

}  // namespace result_test
