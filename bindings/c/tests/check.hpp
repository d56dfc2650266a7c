// A test program is a list of named behaviours; each runs, and the first CHECK that does not hold says where.
#ifndef FLOCKMAP_TESTS_CHECK_HPP
#define FLOCKMAP_TESTS_CHECK_HPP

#include <cstdio>
#include <exception>
#include <functional>
#include <stdexcept>
#include <string>
#include <vector>

struct Test {
    const char* name;
    std::function<void()> body;
};

inline std::vector<Test>& tests() {
    static std::vector<Test> all;
    return all;
}

struct Register {
    Register(const char* name, std::function<void()> body) { tests().push_back({name, std::move(body)}); }
};

#define TEST(name)                                 \
    static void name();                            \
    static const Register register_##name(#name, name); \
    static void name()

#define CHECK(condition)                                                                                        \
    do {                                                                                                        \
        if (!(condition)) {                                                                                     \
            throw std::logic_error(std::string(__FILE__) + ":" + std::to_string(__LINE__) + ": " + #condition); \
        }                                                                                                       \
    } while (false)

int main() {
    int failed = 0;
    for (const auto& test : tests()) {
        try {
            test.body();
            std::printf("ok      %s\n", test.name);
        } catch (const std::exception& error) {
            std::printf("FAILED  %s: %s\n", test.name, error.what());
            ++failed;
        }
    }
    return failed == 0 && !tests().empty() ? 0 : 1;
}

#endif
